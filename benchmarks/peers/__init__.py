"""The shipped world model as others would write it, for benchmarks that compare with them."""
