"""What tests of commands share."""

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax import cli
from vertiwm_jax import config as configuration
from vertiwm_jax.env import suites
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.rl import experiment, policy
from vertiwm_jax.rl.experiment import TrainConfig
from vertiwm_jax.rl.policy import Base, DeterministicPolicy, Policy, PolicyConfig
from vertiwm_jax.terrain.map import TerrainMap

Door = Callable[[Sequence[str]], None]


def door(name: str) -> Door:
    """The command as a function of its arguments."""
    return partial(cli.main, name)


def opened(door: Door, folder: Path, *first: str) -> Callable[..., Path]:
    """The command as a function of its arguments, which gives the newest run folder.

    first: arguments of every run that does not go on with an earlier one.
    """
    runs = folder / "runs"

    def run(*argv: str) -> Path:
        begin = [] if "--resume" in argv else [*first, "--runs", str(runs)]
        door([*begin, *argv])
        return max(runs.iterdir(), key=lambda run: run.stat().st_ctime_ns)

    return run


def refusal(door: Door, *argv: object) -> str:
    """The one line that a command ends in."""
    with pytest.raises(SystemExit) as stop:
        door([str(word) for word in argv])
    message = stop.value.code
    assert isinstance(message, str) and message.startswith("error: ") and "\n" not in message
    return message


def squeezed(table: str) -> str:
    """A table without the spaces that align its columns."""
    return re.sub(" +", " ", table)


def exportable(learned: DeterministicPolicy, base: Base, task: NavigationConfig) -> Policy:
    """A policy that corrects a controller, as if it had been trained; it has no critic."""
    config = PolicyConfig(
        algorithm="ppo",
        hidden=(),
        initial_log_std=None,
        navigation=task,
        base=base,
        action_repeat=8,
        discount=0.99,
        vehicle=vehicle.load("hmmwv"),
        model="builtin",
    )
    return Policy(learned, cast(Any, None), config.controller, config)


def untrained(kind: type[TrainConfig], run: Path) -> list[DeterministicPolicy]:
    """Policies of random weights, one a seed, left as those of the run beside `config.yaml`."""
    config = configuration.load(kind, run / "config.yaml")
    level = TerrainMap.from_array(np.zeros((129, 129)), np.zeros((1, 1), int))
    pool = suites.test_tasks(config.ground, level)
    env, task = experiment.environment(config, "builtin", level, pool)
    algorithm = config.algorithm(env)
    keys = jax.random.split(jax.random.key(0), config.loop.seeds)
    shapes = jax.eval_shape(jax.vmap(algorithm.init, (None, 0)), task, keys)
    rng = np.random.default_rng(0)

    def drawn(leaf):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return keys
        return jnp.asarray(rng.uniform(0.1, 1, leaf.shape), leaf.dtype)

    state = jax.tree.map(drawn, shapes)
    value = algorithm.value(state)
    policy.save(run / policy.FOLDER, config.of_policy, value)
    return [
        algorithm.policy(jax.tree.map(lambda x, i=i: x[i], state)) for i in range(config.loop.seeds)
    ]
