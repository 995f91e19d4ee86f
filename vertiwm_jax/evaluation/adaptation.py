"""How much estimating soils while driving helps, where the map has them wrong."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.adaptation.soil_filter import SoilBelief, SoilFilter, believed
from vertiwm_jax.config import Count, settings
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation.prediction import (
    PredictionErrors,
    TestWindows,
    format_table,
    predict,
    summary,
)
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning import windows as recorded
from vertiwm_jax.learning.dataset import Drives
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.windows import GROUNDS, WindowIndex
from vertiwm_jax.models.registry import ModelName, load_model
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import PRESETS, Soil

CONTEXT = HORIZON = STRIDE = 16
PERIODS = {"0 to 5 s": 0.0, "5 to 10 s": 5.0, "after 10 s": 10.0}
"""Parts of a drive between which errors are told apart, and the seconds when they begin."""


@settings
class AdaptationTest:
    """Open-loop position errors where the map has soils wrong, and how they are adapted to."""

    data: Path
    """Folder of `.npz` files of drives, with the maps they name."""
    model: ModelName = "nesam"
    """The model that adapts."""
    weights: Path | None = None
    """Folder of a fitted model, instead of the one that comes with the package."""
    wrong: str = "snow"
    """What the map is made to say of all soil: a name of `terrain.soil.PRESETS`."""
    split: dataset.Split = "test"
    """Which of the drives."""
    every: Count = 1
    """Of how many drives one is used."""
    filter: SoilFilter = SoilFilter()
    """How soils are estimated."""

    def check(self):
        if self.wrong not in PRESETS:
            raise ValueError(f"wrong: expected one of {', '.join(PRESETS)}, found {self.wrong!r}")

    def run(self) -> str:
        """Runs the test; returns its table as Markdown."""
        drives, terrain = dataset.load_drives(self.data, self.split)
        drives = jax.tree.map(lambda x: x[:: self.every], drives)
        index = windows_on_soil(drives, terrain)
        model, params = load_model(self.model, self.weights, soil="map", exact_gradient=True)
        wrong = mistaken(terrain, PRESETS[self.wrong])
        beliefs = adapt(self.filter, model, params, wrong, drives)
        errors = compare(model, params, terrain, wrong, drives, index, beliefs)
        accepted, refused = (int(x[:, -1].sum()) for x in (beliefs.accepted, beliefs.refused))
        counts = f"Measurements of soils: {accepted} accepted, {refused} refused"
        return f"{format_table(errors, 'position')}\n\n{counts}"


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
) -> list[PredictionErrors]:
    """Errors with the true soils, with the wrong ones, and with those believed, of `adapt`.

    A window is predicted with what was believed when the prediction begins. Windows are grouped by
    the period of the drive in which that is.
    """
    drive, begin = np.asarray(index.drive), np.asarray(index.start) + CONTEXT
    period = np.digitize(begin * STEP_SECONDS, list(PERIODS.values())) - 1
    windows = recorded.gather(drives, replace(index, ground=jnp.asarray(period)))
    test = TestWindows(windows, drive, terrain, tuple(PERIODS))

    def everywhere(soils: Soil) -> Soil:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (len(drive), *x.shape)), soils)

    of_map, of_wrong = (everywhere(query.soils(ground)) for ground in (terrain, wrong))
    # The last block that ended before; -1 where there was none yet.
    block = np.sum(beliefs.steps[drive] <= begin[:, None], axis=1) - 1
    latest = jax.tree.map(lambda x: x[drive, np.maximum(block, 0)], beliefs)
    adapted = jax.vmap(lambda belief: query.soils(believed(wrong, belief)))(latest)
    adapted = jax.tree.map(lambda x, y: jnp.where((block >= 0)[:, None], x, y), adapted, of_wrong)
    rows = {"true soils": of_map, "wrong soils": of_wrong, "wrong soils, adapted": adapted}
    return [
        summary(name, predict(model, params, test, soils).states, test)
        for name, soils in rows.items()
    ]
