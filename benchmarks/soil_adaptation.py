"""How much estimating soils while driving helps predictions, where the map has all soils wrong.

Position errors after 16 steps on soil, m, with the soils of the map, with wrong ones, and with
those that the filter believes in when the prediction begins: mean and 95 % interval over drives, by
how long the drive has lasted then.
"""

from functools import partial
from pathlib import Path
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._harness import parser, report
from vertiwm_jax.adaptation.soil_filter import SoilBelief, SoilFilter, believed
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation.prediction import BATCH, bootstrap
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning import windows as recorded
from vertiwm_jax.learning.dataset import SPLITS, Drives
from vertiwm_jax.learning.objectives import open_loop
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.windows import GROUNDS, WindowIndex, Windows
from vertiwm_jax.models.registry import ModelName, load_model
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import PRESETS, Soil

CONTEXT = HORIZON = STRIDE = 16
PERIODS = {"0 to 5 s": 0.0, "5 to 10 s": 5.0, "after 10 s": 10.0}
"""Parts of a drive between which errors are told apart, and the seconds when they begin."""


def mistaken(terrain: TerrainMap, soil: Soil) -> TerrainMap:
    """The map with one soil, leaves `[]`, for all that is deformable."""
    if len(terrain.soils.n) > 1:
        raise DataError("expected the same soils in all worlds, found worlds that differ in theirs")

    def put(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(terrain.deformable, new, old)

    return terrain.with_soils(jax.tree.map(put, soil, query.soils(terrain)))


@partial(jax.jit, static_argnames=("soil_filter", "model"))
def adapt(
    soil_filter: SoilFilter, model: Dynamics, params: Params, terrain: TerrainMap, drives: Drives
) -> SoilBelief:
    """Estimates soils along D drives, each by itself, all from what the map says.

    Returns:
        Leaves `[D, B, ...]`, what is believed after each of B blocks of H steps, the horizon of the
        filter. After the end of a drive, the belief stays as it is.
    """
    horizon = soil_filter.horizon
    blocks = drives.control.shape[1] // horizon

    def drive(
        world: jax.Array, states: jax.Array, commands: jax.Array, length: jax.Array
    ) -> SoilBelief:
        """Of one drive."""
        ground, path = terrain.select(world), VehicleState.from_vector(states)

        def record(belief: SoilBelief, step: tuple[VehicleState, Command]):
            return soil_filter.record(belief, *step), None

        def block(belief: SoilBelief, steps: tuple[VehicleState, Command]):
            measured, _ = jax.lax.scan(record, belief, steps)
            measured = soil_filter.measure(model, params, ground, measured)
            goes_on = measured.steps <= length
            belief = jax.tree.map(lambda x, y: jnp.where(goes_on, x, y), measured, belief)
            return belief, belief

        after = jax.tree.map(lambda x: x[1:], path)
        steps = jax.tree.map(
            lambda x: x[: blocks * horizon].reshape(blocks, horizon, *x.shape[1:]),
            (after, Command.from_vector(commands)),
        )
        start = soil_filter.init(ground, jax.tree.map(lambda x: x[0], path))
        return jax.lax.scan(block, start, steps)[1]

    given = drives.world, drives.state, drives.control, drives.length
    return jax.vmap(drive)(*map(jnp.asarray, given))


def windows_on_soil(drives: Drives, terrain: TerrainMap) -> WindowIndex:
    """Windows on soil alone; `DataError` when there are none."""
    index = recorded.index(drives, terrain, CONTEXT, HORIZON, STRIDE)
    soft = np.asarray(index.ground) == GROUNDS.index("deformable")
    if not soft.any():
        raise DataError(
            f"expected windows of {CONTEXT + HORIZON} steps on soil alone, found none; "
            "record drives on deformable ground"
        )
    return jax.tree.map(lambda x: x[soft], index)


def compare(
    model: Dynamics,
    params: Params,
    terrain: TerrainMap,
    wrong: TerrainMap,
    drives: Drives,
    index: WindowIndex,
    beliefs: SoilBelief,
) -> dict[str, np.ndarray]:
    """`[N]` m, position errors with the true soils, with the wrong ones, and with those of `adapt`.

    A window is predicted with what was believed when the prediction begins; one whose prediction is
    not finite counts as not having moved.
    """
    drive, begin = np.asarray(index.drive), np.asarray(index.start) + CONTEXT

    def everywhere(soils: Soil) -> Soil:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (len(drive), *x.shape)), soils)

    of_map, of_wrong = (everywhere(query.soils(ground)) for ground in (terrain, wrong))
    # The last block that ended before; -1 where there was none yet.
    block = np.sum(beliefs.steps[drive] <= begin[:, None], axis=1) - 1
    latest = jax.tree.map(lambda x: x[drive, np.maximum(block, 0)], beliefs)
    adapted = jax.vmap(lambda belief: query.soils(believed(wrong, belief)))(latest)
    adapted = jax.tree.map(lambda x, y: jnp.where((block >= 0)[:, None], x, y), adapted, of_wrong)
    rows = {"true": of_map, "wrong": of_wrong, "wrong, adapted": adapted}
    windows = recorded.gather(drives, index)
    return {
        name: np.asarray(_errors(model, params, terrain, windows, soils))
        for name, soils in rows.items()
    }


@partial(jax.jit, static_argnames="model")
def _errors(
    model: Dynamics, params: Params, terrain: TerrainMap, windows: Windows, soils: Soil
) -> jax.Array:
    """`[N]` m after the last step; soils: leaves `[N, K]`."""

    def one(inputs: tuple[Windows, Soil]) -> jax.Array:
        window, soils = inputs
        ground = terrain.select(window.world).with_soils(soils)
        final = open_loop(model, params, ground, window, lambda _: None)[0].position[-1]
        final = jnp.where(jnp.isfinite(final).all(), final, window.state[window.context, :3])
        return jnp.linalg.norm(final - window.state[-1, :3])

    return jax.lax.map(one, (windows, soils), batch_size=BATCH)


def periods(index: WindowIndex) -> dict[str, np.ndarray]:
    """By period of a drive, `[N]` bool, whether the prediction of a window begins in it."""
    begin = (np.asarray(index.start) + CONTEXT) * STEP_SECONDS
    found = np.digitize(begin, list(PERIODS.values())) - 1
    return {name: found == i for i, name in enumerate(PERIODS) if (found == i).any()}


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--data", type=Path, required=True, help="folder of drives")
    arguments.add_argument("--model", choices=get_args(ModelName), default="nesam")
    arguments.add_argument("--weights", type=Path, help="folder of a fitted model")
    arguments.add_argument("--wrong", choices=PRESETS, default="snow", help="what all soil is said")
    arguments.add_argument("--split", choices=SPLITS, default="test", help="which of the drives")
    arguments.add_argument("--every", type=int, default=1, help="of how many drives one is used")
    chosen = arguments.parse_args()
    drives, terrain = dataset.load_drives(chosen.data, chosen.split)
    drives = jax.tree.map(lambda x: x[:: chosen.every], drives)
    index = windows_on_soil(drives, terrain)
    model, params = load_model(chosen.model, chosen.weights, soil="map", exact_gradient=True)
    wrong = mistaken(terrain, PRESETS[chosen.wrong])
    beliefs = adapt(SoilFilter(), model, params, wrong, drives)
    errors = compare(model, params, terrain, wrong, drives, index, beliefs)
    results: dict[str, dict[str, str | int]] = {
        f"{name} soils": {
            f"{when} (n = {here.sum()})": str(bootstrap(error[here], np.asarray(index.drive)[here]))
            for when, here in periods(index).items()
        }
        for name, error in errors.items()
    }
    counts = {name: int(getattr(beliefs, name)[:, -1].sum()) for name in ("accepted", "refused")}
    report("soil_adaptation", results | {"measurements": counts}, chosen.json)


if __name__ == "__main__":
    main()
