import os
import signal

# The suite is a statement about the CPU in float32; before anything imports jax.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Compiling is most of what the tests do, and three times as fast without optimisation. To test what
# users run, set XLA_FLAGS to nothing.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false",
)

import jax
import pytest

# Shells start what runs in the background with Ctrl-C ignored, and tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """XLA maps memory for every program; those of all modules pass the system's limit of maps."""
    yield
    jax.clear_caches()
