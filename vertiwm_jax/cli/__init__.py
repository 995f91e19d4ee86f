"""The command line: `vertiwm COMMAND ...`, for most also `python -m vertiwm_jax.COMMAND ...`.

Each module of this package is one command, and `train` all that train policies: `run` reads the
rest of the command line, calls the library, and prints what came of it.
"""

import gc
import logging
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

import jax

from vertiwm_jax import hosts, machine, xla
from vertiwm_jax.errors import TrainingInterrupted, UserError

_TRAININGS = ("ppo", "sac", "td3")
COMMANDS = (
    *_TRAININGS, "fit", "evaluate", "compare", "collect", "import_drives", "export",
    "view", "identify",
)  # fmt: skip
_RESUME = "go on from the newest checkpoint with --resume and the run folder"
GOING_ON = dict.fromkeys(hosts.COMMANDS, _RESUME) | {
    "compare": "go on with --resume and the run folder",
    "collect": "the same command goes on with the worlds that are left",
}
"""What to do after Ctrl-C."""


def main(name: str | None = None, words: Sequence[str] | None = None) -> None:
    """Runs a command; expected failures end in one line and a status that is not 0.

    Args:
        name: the command; by default the first of the words.
        words: what follows the name; by default the command line of this process, which is then
            prepared for the command before JAX starts.
    """
    own = words is None
    words = sys.argv[1:] if words is None else list(words)
    if name is None:
        name, words = (words[0] if words else ""), words[1:]
    if name not in COMMANDS:
        asked = name in ("-h", "--help")
        usage = f"usage: vertiwm {{{','.join(COMMANDS)}}} ...; each tells its options by --help"
        sys.exit(print(usage) if asked else f"{usage}; found {name!r}")
    if own:
        prepare(name)
    with failures_in_one_line(name), told():
        machine.refuse_forked()
        module = "train" if name in _TRAININGS else name
        import_module(f"{__name__}.{module}").run(name, words)


def prepare(name: str) -> None:
    """Sets up all cores and hosts for a command; to be called before gymnax, which starts JAX."""
    machine.use_cores()
    xla.keep_compiled()
    # Tracing makes many lasting objects; looking for garbage among them is a sixth of its time.
    gc.set_threshold(100_000, 50, 50)
    # gymnax imports it to draw Pong, which would be two seconds of every start.
    sys.modules.setdefault("seaborn", ModuleType("seaborn"))
    jax.config.update("jax_enable_x64", False)
    hosts.join(name)


@contextmanager
def failures_in_one_line(name: str) -> Iterator[None]:
    """Ends the process with one line and a status that is not 0 where the user can correct it."""
    try:
        yield
    except TrainingInterrupted as stopped:
        print(stopped)
        sys.exit(130)
    except KeyboardInterrupt:
        print(f"stopped at once; {GOING_ON.get(name, 'nothing was written')}")
        hosts.leave(130)
    except (UserError, OSError) as error:
        hosts.leave(f"error: {error}")
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        # XLA raises either, beginning with a status like "UNKNOWN: ", where a connection breaks.
        if jax.process_count() == 1 or not re.match("[A-Z_]+: ", str(error)):
            raise
        hosts.leave(
            f"error: another host has stopped or cannot be reached; {_RESUME}: "
            f"{str(error).splitlines()[0]}"
        )


class _Teller(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), flush=True)


@contextmanager
def told() -> Iterator[None]:
    """Prints what the library logs, while the context is open."""
    log, teller = logging.getLogger("vertiwm_jax"), _Teller()
    level, propagate = log.level, log.propagate
    log.addHandler(teller)
    log.setLevel(logging.INFO)
    log.propagate = False  # Packages that are imported later may print what reaches the root.
    try:
        yield
    finally:
        log.removeHandler(teller)
        log.setLevel(level)  # Assigning the attribute would leave what `logging` has cached.
        log.propagate = propagate
