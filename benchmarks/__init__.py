"""One script a claim: `python -m benchmarks.NAME [--json]`."""

from vertiwm_jax import machine

# Before gymnax is imported, which starts JAX.
machine.use_cores()
