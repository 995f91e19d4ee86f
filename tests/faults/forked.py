"""MAPS OUTPUT SECONDS: how commands end in processes that were forked after JAX had started.

Prints JSON: by the name of the command the line that it ends in, or None where it does not end.
"""

import json
import multiprocessing
import sys
import time
import warnings
from collections.abc import Sequence
from multiprocessing.connection import Connection

import jax
import jax.numpy as jnp

from vertiwm_jax import cli
from vertiwm_jax.cli import collect, evaluate  # noqa: F401, before it forks


def run(name: str, argv: Sequence[str], ends: Connection) -> None:
    """Sends the one line that the command ends in."""
    try:
        cli.main(name, argv)
        ends.send("")
    except SystemExit as stop:
        ends.send(str(stop.code))


def main(maps: str, output: str, seconds: float) -> None:
    jax.jit(jnp.sin)(jnp.zeros(3)).block_until_ready()
    commands = {
        "collect": ["--output", output, "--terrain", maps, "--seconds", "0.1"],
        "evaluate": ["navigation", "--policy", "straight", "--terrain", maps],
    }
    forking, waiting = multiprocessing.get_context("fork"), {}
    for name, argv in commands.items():
        ours, theirs = forking.Pipe(duplex=False)
        process = forking.Process(target=run, args=(name, argv, theirs))
        process.start()
        theirs.close()  # So that one that fails otherwise is not waited for.
        waiting[name] = process, ours
    found, end = dict.fromkeys(commands), time.monotonic() + seconds
    for name, (process, ours) in waiting.items():
        if ours.poll(max(end - time.monotonic(), 0)):
            found[name] = ours.recv()
        process.kill()
        process.join()
    print(json.dumps(found))


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # JAX warns of what this is about.
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
