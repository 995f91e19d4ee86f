import os
import shutil
import signal
import tempfile
from pathlib import Path

# The suite is a statement about the CPU in float32; before anything imports jax.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# So that what is shared out to devices is, also where a worker has one core.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")
# Workers keep compiled programs where the process that starts them does, which removes the folder.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", os.path.join(tempfile.gettempdir(), f"vertiwm-tests-{os.getpid()}")
)

import jax
import pytest

from vertiwm_jax import xla

# Compiling is most of what the tests do, and three times as fast without optimisation. To test what
# users run, set XLA_FLAGS to nothing.
if "XLA_FLAGS" not in os.environ:
    xla.add_flags(
        {
            "xla_backend_optimization_level": 0,
            "xla_llvm_disable_expensive_passes": "true",
            "xla_backend_extra_options": "xla_cpu_disable_new_fusion_emitters",
        }
    )

# One core for each of several workers. With more threads results may differ from call to call
# (jax-ml/jax#39741), and workers only get in each other's way.
worker = os.environ.get("PYTEST_XDIST_WORKER")
if worker and hasattr(os, "sched_setaffinity"):
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})

# Shells start what runs in the background with Ctrl-C ignored, and tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_unconfigure() -> None:
    """Removes what was compiled."""
    kept = os.environ["JAX_COMPILATION_CACHE_DIR"]
    if kept.endswith(f"vertiwm-tests-{os.getpid()}"):
        shutil.rmtree(kept, ignore_errors=True)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks all tests in the folders of commands, faults and golden numbers."""
    folders = {Path(__file__).parent / name for name in ("integration", "faults", "golden")}
    for item in items:
        if folders & set(item.path.parents):
            item.add_marker("integration")


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """XLA maps memory for every program; those of all modules pass the system's limit of maps."""
    yield
    jax.clear_caches()
