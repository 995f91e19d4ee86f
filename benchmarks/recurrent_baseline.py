"""What a small recurrent network with sampled heights makes of the same drives.

It sees the heights about it on a grid, and the class of the ground under each wheel, and is fitted
and tested as the world model is: the row of the prediction table that any design has to beat.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from benchmarks._harness import parser, report
from vertiwm_jax.evaluation import prediction
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import calibration, dataset, fitting
from vertiwm_jax.learning.fitting import FitConfig
from vertiwm_jax.learning.losses import LossConfig
from vertiwm_jax.learning.objectives import RolloutLoss
from vertiwm_jax.learning.problem import WindowConfig, WindowData, WindowProblem
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.runs import Run
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.normalization import INPUTS, Normalization

UNITS = 256
RELIEF = 0.5
"""Typical height of the ground about a vehicle, m."""
AHEAD = np.linspace(-3.5, 5.5, 13, dtype=np.float32)
LEFT = np.linspace(-2.1, 2.1, 8, dtype=np.float32)
GRID = np.stack(np.meshgrid(AHEAD, LEFT, indexing="ij"), axis=-1).reshape(-1, 2)
"""Where heights are sampled, m in the body."""


class Network(nn.Module):
    """`[F]` features of a step and the memory `[UNITS]` to twelve numbers and the next memory."""

    @nn.compact
    def __call__(self, hidden: jax.Array, features: jax.Array) -> tuple[jax.Array, jax.Array]:
        token = nn.silu(nn.Dense(UNITS)(features))
        hidden, output = nn.GRUCell(UNITS)(hidden, token)
        return hidden, nn.Dense(12, kernel_init=nn.initializers.zeros)(output)


@struct.dataclass
class RecurrentParams:
    """network: weights; normalization: measured on drives."""

    network: Any
    normalization: Normalization


@dataclass(frozen=True)
class Recurrent:
    """The `Dynamics`, whose history is the memory of the network."""

    def init_params(
        self, key: jax.Array, constants: Normalization, classes: int
    ) -> RecurrentParams:
        """Untrained weights for maps of that many classes."""
        features = jnp.zeros(INPUTS + len(GRID) + 4 * classes)
        return RecurrentParams(Network().init(key, jnp.zeros(UNITS), features), constants)

    def init(self, params: RecurrentParams, terrain: TerrainMap, state: VehicleState) -> jax.Array:
        return jnp.zeros(UNITS)

    def step(
        self,
        params: RecurrentParams,
        terrain: TerrainMap,
        history: jax.Array,
        state: VehicleState,
        command: Command,
    ) -> tuple[VehicleState, jax.Array]:
        constants, yaw = params.normalization, state.rpy[2]
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        to_world = jnp.array([[cos, sin], [-sin, cos]])
        here = state.position[:2]
        around = query.height(terrain, here + GRID @ to_world) - state.position[2]
        wheels = query.surface(terrain, here + load_vehicle().wheel_position @ to_world)
        features = [
            constants.inputs(state, command),
            around / RELIEF,
            jax.nn.one_hot(wheels.semantic, len(terrain.deformable)).ravel(),
        ]
        memory, output = cast(
            tuple[jax.Array, jax.Array],
            Network().apply(params.network, history, jnp.concatenate(features)),
        )
        return motion.advance(state, constants.transition(output)), memory


def fitted(folders: list[Path], updates: int, runs: Path) -> tuple[Recurrent, RecurrentParams]:
    """From the training drives in `folders`; the run folder keeps its checkpoints."""
    training, validation = (
        dataset.load_drives(folders, split, dataset.FITTED) for split in ("train", "validation")
    )
    config = FitConfig(updates=updates, weight_decay=0.05, trainable=("network",))
    windows = WindowConfig(context=8, weights=(1.0, 1.0, 2.0))
    model = Recurrent()
    constants = calibration.normalization(training[0])
    params = model.init_params(jax.random.key(0), constants, len(training[1].deformable))
    problem = WindowProblem(model, RolloutLoss(model, LossConfig(velocity=0.05)), windows)
    data = WindowData.of(windows, training, validation)
    with Run.create(runs, "recurrent", config) as run:
        return model, fitting.fit(problem, config, params, data, jax.random.key(1), run)


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument(
        "--data", nargs="+", type=Path, required=True, help="folders to learn from"
    )
    arguments.add_argument("--test", type=Path, required=True, help="folder to be tested on")
    arguments.add_argument("--updates", type=int, default=12_000)
    arguments.add_argument("--runs", type=Path, default=Path("runs"))
    chosen = arguments.parse_args()
    model, params = fitted(chosen.data, chosen.updates, chosen.runs)
    test = TestWindows.of(
        *dataset.load_drives(chosen.test, "test"), context=16, horizon=16, stride=16
    )
    states = prediction.predict(model, params, test).states
    errors = prediction.summary("recurrent", states, test)
    weights = sum(x.size for x in jax.tree.leaves(params.network))
    results = {
        f"16-step position error, {kind}": {
            "mean_m": x.mean, "low_m": x.low, "high_m": x.high, "weights": weights
        }
        for kind, x in errors.final["position"].items()
    }  # fmt: skip
    report("recurrent_baseline", results, chosen.json)


if __name__ == "__main__":
    main()
