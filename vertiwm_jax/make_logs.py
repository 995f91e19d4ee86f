"""`vertiwm make_logs`: recorded drives as a vehicle would have logged them."""

if __name__ == "__main__":
    from vertiwm_jax.cli import main

    main("make_logs")
