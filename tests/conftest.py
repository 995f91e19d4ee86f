import os

# The suite is a statement about the CPU in float32; before anything imports jax.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import pytest


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """XLA maps memory for every program; those of all modules pass the system's limit of maps."""
    yield
    jax.clear_caches()
