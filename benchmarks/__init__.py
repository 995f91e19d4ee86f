"""One script a claim: `python -m benchmarks.NAME [--json]`."""

from vertiwm_jax import devices

# Before gymnax is imported, which starts JAX.
devices.use_cores()
