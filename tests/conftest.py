import os
import signal

# The suite is a statement about the CPU in float32; before anything imports jax.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import pytest

# Shells start what runs in the background with Ctrl-C ignored, and tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """XLA maps memory for every program; those of all modules pass the system's limit of maps."""
    yield
    jax.clear_caches()
