"""CASE...: which kinds of floating-point numbers each case is computed in, as JSON.

For a process with JAX_ENABLE_X64 or JAX_DEBUG_NANS set. What cannot be traced is told by its error.
"""

import json
import sys
from collections.abc import Callable
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
from env.worlds import GRASS, bicycle_env, ground

import vertiwm_jax.gym  # Registers the task.
from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.dynamics import Dynamics, rollout
from vertiwm_jax.env.controllers import LookAhead
from vertiwm_jax.env.navigation import NavigationEnv, make_env
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.evaluation.navigation import evaluate
from vertiwm_jax.mechanics.kinematic import KinematicBicycle, bicycle_of, place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.registry import load_model
from vertiwm_jax.rl.ppo import PPO, PPOConfig
from vertiwm_jax.rl.sac import SAC, SACConfig
from vertiwm_jax.rl.td3 import TD3, TD3Config
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.map import TerrainMap

COLLECTED = {"total_timesteps": 64, "num_envs": 8, "num_steps": 8, "hidden": (8,)}
REPLAYED = COLLECTED | {"updates": 1, "batch": 8, "buffer_size": 64, "learning_starts": 64}


def drive(model: Dynamics, params: Any) -> VehicleState:
    """Half a second as the README drives, without compiling it."""
    terrain = TerrainMap.from_array(np.zeros((41, 41)), np.full((4, 4), GRASS))
    start = place(terrain)
    commands = Command(jnp.full(5, 3.0), jnp.full(5, 0.1))
    return jax.eval_shape(
        lambda params: rollout(model, params, terrain, start, commands),
        params,
    )


def learn(algorithm: Callable[[NavigationEnv], Any]) -> Any:
    """Two iterations of a training in the bicycle: the first with no episode that ends."""
    terrain = ground()
    env, params = bicycle_env(terrain, circle_tasks(terrain, pairs=1))
    made = algorithm(env)
    first, metrics = jax.jit(made.iterate)(params, made.init(params, jax.random.key(0)))
    if float(metrics["episodes"]):
        raise RuntimeError("an episode ended")
    return jax.jit(made.iterate)(params, first)


def driven() -> Any:
    """Whole episodes, compiled and run."""
    env, _ = make_env(ground(), "bicycle", pairs=1)
    return evaluate(LookAhead(env.config), ground(), model="bicycle", pairs=1)


RUN = {
    "driven": driven,
    "ppo": lambda: learn(lambda env: PPO(env, PPOConfig(**COLLECTED, minibatches=2, epochs=1))),
    "sac": lambda: learn(lambda env: SAC(env, SACConfig(**REPLAYED))),
    "td3": lambda: learn(lambda env: TD3(env, TD3Config(**REPLAYED))),
}
CASES = {
    "worlds": lambda: worlds.generate(jax.random.split(jax.random.key(0), 1), worlds.WorldConfig()),
    "bicycle": lambda: drive(KinematicBicycle(), bicycle_of(load_vehicle())),
    "simulator": lambda: drive(Simulator(), chrono_like(load_vehicle())),
    "shipped weights": lambda: drive(*load_model("vertiwm")),
    "gymnax": lambda: gymnax.make(vertiwm_jax.gym.GYMNAX_NAME, terrain=ground(), pairs=1)[1],
} | RUN


def computed_in(case: Callable[[], Any]) -> list[str]:
    try:
        leaves = jax.tree.leaves(case())
    except (TypeError, CheckpointError) as error:
        return [f"{type(error).__name__}: {' '.join(str(error).split())}"]
    return sorted({str(x.dtype) for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)})


if __name__ == "__main__":
    print(json.dumps({name: computed_in(CASES[name]) for name in sys.argv[1:]}))
