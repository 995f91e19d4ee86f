"""Several hosts that compute together: the same command on each, joined by `jax.distributed`.

All hosts compute the same from the same settings. Where they could differ, by a rounding or by what
a user does, they exchange values and agree. Only the first host prints and keeps results.
"""

import atexit
import os
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

T = TypeVar("T")

COMMANDS = ("ppo", "sac", "td3", "fit")
"""Commands that several hosts can run together."""
_VARIABLES = "JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
_LONGEST_PATH = 4096  # bytes
_PATIENCE = 60  # seconds that a process waits for the others at its end, whatever ended it


def join(command: str) -> None:
    """Joins this process, which runs a command, with others if the environment says so.

    `JAX_COORDINATOR_ADDRESS` is HOST:PORT of the first process, `JAX_NUM_PROCESSES` their number
    and `JAX_PROCESS_ID`, from 0, the number of this one. Variables that are not set come from the
    cluster, if JAX knows it (SLURM, Open MPI). If joining fails, the process ends with one line.
    """
    if not any(name in os.environ for name in _VARIABLES):
        return
    if command not in COMMANDS:
        sys.exit(
            f"error: {command}: expected one process, found {_found()}; unset them, only "
            f"{', '.join(COMMANDS)} run on several hosts"
        )
    # Its handler would swallow SIGTERM, at which a training saves and stops.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        number, own = (int(os.environ[x]) if x in os.environ else None for x in _VARIABLES[1:])
        jax.distributed.initialize(
            num_processes=number, process_id=own, shutdown_timeout_seconds=_PATIENCE
        )
    except (ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        sys.exit(f"error: {', '.join(_VARIABLES)}: cannot join, found {_found()}: {reason}")
    each = Counter(device.process_index for device in jax.devices())
    if len(set(each.values())) > 1:
        sys.exit(
            "error: expected as many devices on every host, found "
            f"{[each[index] for index in sorted(each)]}; JAX_NUM_CPU_DEVICES sets those of a CPU"
        )
    if not is_first():
        # For as long as it runs: what the first one prints is what there is to say. Errors stay.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def is_first() -> bool:
    """Whether this is the first process, whose results are kept."""
    return jax.process_index() == 0


def on_any(flag: bool) -> bool:
    """Whether the flag is set on any host; all hosts have to call this."""
    return bool(np.any(multihost_utils.process_allgather(np.array(flag))))


def of_first(tree: T) -> T:
    """The first host's values of a pytree of NumPy arrays; all hosts have to call this."""
    return multihost_utils.broadcast_one_to_all(tree)


def path_of_first(path: Path) -> Path:
    """The first host's path; all hosts have to call this."""
    encoded = os.fsencode(path).ljust(_LONGEST_PATH, b"\0")
    sent = of_first(np.frombuffer(encoded, np.uint8))
    return Path(os.fsdecode(sent.tobytes().rstrip(b"\0")))


def own(folder: Path) -> Path:
    """`folder` on the first host; on others an empty one, deleted when the process ends."""
    if is_first():
        return folder
    scratch = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, scratch, ignore_errors=True)
    return scratch


def own_copy(folder: Path) -> Path:
    """`folder` on the first host; on others a copy, made before the first one changes it."""
    place = own(folder)
    if place != folder:
        shutil.copytree(folder, place, dirs_exist_ok=True)
    multihost_utils.sync_global_devices("copied")
    return place


def leave(status: int | str) -> NoReturn:
    """Ends this process like `sys.exit`, but at once where others wait, so that they notice."""
    if jax.process_count() == 1:
        sys.exit(status)
    if isinstance(status, str):
        print(status, file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(1 if isinstance(status, str) else status)  # Else JAX would wait for the others here.


def without_keys(tree: Any) -> Any:
    """The pytree with random keys replaced by their data, which NumPy and files can hold."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)


def with_keys(like: T, tree: Any) -> T:
    """The inverse of `without_keys`; random keys are where `like` has them."""
    return jax.tree.map(lambda x, y: jax.random.wrap_key_data(y) if _is_key(x) else y, like, tree)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jax.dtypes.prng_key)


def _found() -> str:
    return ", ".join(f"{name}={os.environ[name]}" for name in _VARIABLES if name in os.environ)
