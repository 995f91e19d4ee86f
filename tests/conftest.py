import os

# The suite is a statement about the CPU in float32; before anything imports jax.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
