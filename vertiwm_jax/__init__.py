"""Fast, differentiable world models for off-road reinforcement learning, in JAX."""

import sys

from vertiwm_jax import devices, hosts

__version__ = "0.1.0"

# While Python looks for what to run by `-m`, that is all that it says: a command of this package
# will run, and it is to use all cores, on all hosts. Later is too late, for to import gymnax starts
# JAX.
if sys.argv[:1] == ["-m"]:
    devices.use_cores()
    hosts.join(hosts.command())
