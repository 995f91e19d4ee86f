"""Transitions a second of PPO, all included: by default and on the paper's schedule.

A transition is 0.1 s of driving. Beside them the algorithm alone, on an environment that costs
nothing, with an observation of the same size. Verti-WM is the shipped one, or with
`--size paper` one of the paper's size and with four encoders, of random weights, for none ships.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces

from benchmarks._harness import Figures, measure, parser, report
from benchmarks.models import PAPER
from vertiwm_jax import config as configuration
from vertiwm_jax import parallel
from vertiwm_jax.env.observation import OBSERVATION_SIZE
from vertiwm_jax.env.task import TaskParams
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models import files
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.networks.specialist import ComputeDtype
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.algorithm import PolicyAlgorithm
from vertiwm_jax.rl.experiment import PPOTraining, TrainConfig
from vertiwm_jax.rl.ppo import PPO
from vertiwm_jax.training import Seeds


@struct.dataclass
class Idle(environment.EnvState):
    observation: jax.Array


@dataclass(frozen=True)
class IdleEnv(environment.Environment):
    """Decays to what the action says; episodes of the length of a navigation task."""

    def step_env(self, key, state, action, params):
        observation = 0.9 * state.observation + 0.1 * jnp.sum(action)
        reward = -jnp.mean(jnp.abs(observation))
        state = Idle(time=state.time + 1, observation=observation)
        return observation, state, reward, jnp.array(False), {}

    def reset_env(self, key, params):
        observation = jax.random.normal(key, (OBSERVATION_SIZE,))
        return observation, Idle(time=jnp.int32(0), observation=observation)

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (2,))


def iteration(ppo: PolicyAlgorithm[Any], params: Any) -> Figures:
    """On as many devices as a training has, and on one of them, with all cores to itself."""
    algorithm, results = Seeds(ppo, 1), {}
    start = jax.jit(algorithm.init)(params, jax.random.key(0))
    for name, mesh in (("", algorithm.mesh), ("one_device_", parallel.mesh(1))):
        whole, state = parallel.place(mesh, params), parallel.place(mesh, start, algorithm.specs)
        with jax.set_mesh(mesh):
            figures = measure(jax.jit(algorithm.iterate), whole, state, repeats=3)
        rate = ppo.timesteps / figures["median_s"]
        results |= {f"{name}transitions_per_s": rate}
        results |= figures | {"devices": mesh.size} if not name else {}
    return results


def of_task(name: str, model: ModelName, weights: Path | None, dtype: ComputeDtype) -> Figures:
    """An iteration of the training that the configuration `name` describes, inside a model."""
    file = configuration.default_config(name)
    config = configuration.load(PPOTraining, file)
    config = replace(config, model=model, weights=weights, compute_dtype=dtype)
    return iteration(*training(config))


def training(config: TrainConfig) -> tuple[PolicyAlgorithm[Any], TaskParams]:
    """The algorithm of a training, and what it learns from."""
    terrain, pool, _ = experiment.training_ground(config)
    env, task = experiment.environment(config, config.model, terrain, pool, config.variation)
    return config.algorithm(env), task


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--configs", nargs="+", default=("ppo", "paper/ppo"))
    arguments.add_argument("--models", nargs="+", default=("builtin", "vertiwm"))
    arguments.add_argument("--size", choices=("base", "paper"), default="base", help="of Verti-WM")
    arguments.add_argument(
        "--compute-dtype",
        nargs="+",
        choices=get_args(ComputeDtype),
        default=("float32",),
        help="of models",
    )
    chosen = arguments.parse_args()
    idle = environment.EnvParams(max_steps_in_episode=600)
    results = {"algorithm alone": iteration(PPO(IdleEnv(), PPOTraining().ppo), idle)}
    with tempfile.TemporaryDirectory() as folder:
        weights = None
        if chosen.size == "paper":
            weights = Path(folder)
            params = PAPER.init_params(jax.random.key(0), chrono_like(load_vehicle()))
            files.save(weights, PAPER, params)
        for name in chosen.configs:
            for model in chosen.models:
                for dtype in chosen.compute_dtype:
                    row = of_task(name, model, weights, dtype)
                    results[f"{name}, {model}, {dtype}"] = row
    report("ppo_throughput", results, chosen.json)


if __name__ == "__main__":
    main()
