"""Fast, differentiable world models for off-road reinforcement learning, in JAX."""

import gc
import sys

from vertiwm_jax import hosts, machine

__version__ = "0.1.0"

# While Python looks for what to run by `-m`, that is all that it says: a command of this package
# will run, and it is to use all cores, on all hosts. Later is too late, for to import gymnax starts
# JAX.
if sys.argv[:1] == ["-m"]:
    machine.use_cores()
    # Tracing makes many objects that stay: to look for garbage among them is a sixth of its time.
    gc.set_threshold(100_000, 50, 50)
    hosts.join(hosts.command())
