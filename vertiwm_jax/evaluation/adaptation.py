"""What adapting soils is worth: predictions with soils that the map has wrong, and corrected."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.adaptation.soil_filter import SoilBelief, SoilFilter, believed
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation.prediction import BATCH, Interval, bootstrap
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.learning import windows as recorded
from vertiwm_jax.learning.dataset import Drives
from vertiwm_jax.learning.objectives import open_loop
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.windows import GROUNDS, WindowIndex, Windows
from vertiwm_jax.mechanics.equilibrium import equilibrium_sinkage
from vertiwm_jax.mechanics.simulator import SimulatorParams, stiffened
from vertiwm_jax.mechanics.vehicle import GRAVITY
from vertiwm_jax.mechanics.wheel import Wheel
from vertiwm_jax.state import STEP_SECONDS, Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import Soil

CONTEXT = HORIZON = STRIDE = 16
PERIODS = (0.0, 5.0, 10.0, np.inf)
"""Seconds of a drive between which errors are told apart."""
SLIP, SPEED = 0.2, 2.0
"""Slip ratio and speed, m/s, at which drawbar pull is compared."""
LEAST = 5
"""Measurements of a soil after which it counts as adapted to."""


@dataclass(frozen=True)
class Adapted:
    """What is believed along D drives, after each of B blocks of H steps.

    soils: leaves `[D, B, K]`. accepted, refused: `[D, B, K]` measurements so far. every: H.
    """

    soils: Soil
    accepted: np.ndarray
    refused: np.ndarray
    every: int


def mistaken(terrain: TerrainMap, soil: Soil) -> TerrainMap:
    """The map with one soil `[]` for all that is deformable."""
    if len(terrain.soils.n) > 1:
        raise DataError("expected the same soils in all worlds, found worlds that differ in theirs")

    def put(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(terrain.deformable, new, old)

    return terrain.with_soils(jax.tree.map(put, soil, query.soils(terrain)))


def adapt(
    soil_filter: SoilFilter, model: Dynamics, params: Params, terrain: TerrainMap, drives: Drives
) -> Adapted:
    """Every drive by itself, all from what the map says."""
    beliefs = _follow(soil_filter, model, params, terrain, jax.tree.map(jnp.asarray, drives))
    soils = jax.jit(jax.vmap(jax.vmap(lambda x: query.soils(believed(terrain, x)))))(beliefs)
    counts = np.asarray(beliefs.accepted), np.asarray(beliefs.refused)
    return Adapted(soils, *counts, soil_filter.horizon)


@partial(jax.jit, static_argnames=("soil_filter", "model"))
def _follow(
    soil_filter: SoilFilter, model: Dynamics, params: Params, terrain: TerrainMap, drives: Drives
) -> SoilBelief:
    """Leaves `[D, B, ...]`; drives go side by side, so that all of them measure at once."""
    steps = soil_filter.horizon
    blocks = drives.control.shape[1] // steps

    def blocked(x: jax.Array) -> jax.Array:
        return jnp.moveaxis(x[:, : blocks * steps].reshape(len(x), blocks, steps, -1), 1, 0)

    def one(
        before: SoilBelief, world: jax.Array, states: jax.Array, controls: jax.Array, on: jax.Array
    ) -> SoilBelief:
        def record(belief: SoilBelief, step: tuple[jax.Array, jax.Array]):
            state, control = VehicleState.from_vector(step[0]), Command.from_vector(step[1])
            return soil_filter.record(belief, state, control), None

        belief, _ = jax.lax.scan(record, before, (states, controls))
        belief = soil_filter.measure(model, params, terrain.select(world), belief)
        return jax.tree.map(lambda x, y: jnp.where(on, x, y), belief, before)

    def block(belief: SoilBelief, inputs: tuple[jax.Array, ...]) -> tuple[SoilBelief, SoilBelief]:
        belief = jax.vmap(one)(belief, jnp.asarray(drives.world), *inputs)
        return belief, belief

    state, control = jnp.asarray(drives.state), jnp.asarray(drives.control)
    driven = steps * (1 + jnp.arange(blocks))[:, None] <= drives.length
    first = jax.vmap(lambda x: soil_filter.init(terrain, VehicleState.from_vector(x)))(state[:, 0])
    _, beliefs = jax.lax.scan(block, first, (blocked(state[:, 1:]), blocked(control), driven))
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), beliefs)


def windows_on_soil(drives: Drives, terrain: TerrainMap) -> WindowIndex:
    """Windows on soil alone; `DataError` when there is none."""
    index = recorded.index(drives, terrain, CONTEXT, HORIZON, STRIDE)
    soft = np.asarray(index.ground) == GROUNDS.index("deformable")
    if not soft.any():
        raise DataError(
            f"expected windows of {CONTEXT + HORIZON} steps on soil alone, found none; "
            "record drives on deformable ground"
        )
    return jax.tree.map(lambda x: x[soft], index)


def errors(
    model: Dynamics,
    params: Params,
    terrain: TerrainMap,
    wrong: TerrainMap,
    adapted: Adapted,
    drives: Drives,
    index: WindowIndex,
) -> dict[str, dict[str, tuple[int, Interval]]]:
    """By the soils of the map and then by period of the drive: windows, and position error, m.

    A window is predicted with what was believed when it begins; one whose prediction is not finite
    counts as not having moved.
    """
    test, drive = recorded.gather(drives, index), np.asarray(index.drive)
    begins = np.asarray(index.start) + CONTEXT
    block = begins // adapted.every - 1
    rows = {
        "true": _repeated(query.soils(terrain), len(drive)),
        "wrong": _repeated(query.soils(wrong), len(drive)),
        "wrong, adapted": jax.tree.map(
            lambda x, y: jnp.where((block >= 0)[:, None], x[drive, np.maximum(block, 0)], y),
            adapted.soils,
            query.soils(wrong),
        ),
    }
    period = np.digitize(begins * STEP_SECONDS, PERIODS) - 1
    places = {_period(i): period == i for i in np.unique(period)}
    found = {}
    for name, soils in rows.items():
        error = np.asarray(_errors(model, params, terrain, test, soils))
        found[name] = {
            when: (int(here.sum()), bootstrap(error[here], drive[here]))
            for when, here in places.items()
        }
    return found


@partial(jax.jit, static_argnames="model")
def _errors(
    model: Dynamics, params: Params, terrain: TerrainMap, test: Windows, soils: Soil
) -> jax.Array:
    """`[N]` m after the last step; soils: leaves `[N, K]`."""

    def one(inputs: tuple[Windows, Soil]) -> jax.Array:
        window, believed_in = inputs
        ground = terrain.select(window.world).with_soils(believed_in)
        final = open_loop(model, params, ground, window, lambda _: None)[0].position[-1]
        final = jnp.where(jnp.isfinite(final).all(), final, window.state[window.context, :3])
        return jnp.linalg.norm(final - window.state[-1, :3])

    return jax.lax.map(one, (test, soils), batch_size=BATCH)


def behaviour(params: SimulatorParams, soil: Soil) -> tuple[jax.Array, jax.Array]:
    """What of soils `[...]` a vehicle feels: sinkage, m, and drawbar pull, N, of one wheel.

    Under a quarter of the weight, on fresh soil, at a usual slip and speed.
    """
    vehicle, soil = params.vehicle, stiffened(params, soil)
    wheel, load = Wheel(vehicle.wheel_radius, vehicle.wheel_width), vehicle.mass * GRAVITY / 4
    motion = SPEED, 0.0, SPEED / (1 - SLIP) / vehicle.wheel_radius
    sinkage = equilibrium_sinkage(wheel, soil, params.contact, load, *motion)
    return sinkage, params.contact.forces(wheel, soil, sinkage, *motion).longitudinal


def recovery(
    params: SimulatorParams, terrain: TerrainMap, wrong: TerrainMap, adapted: Adapted
) -> list[dict[str, str]]:
    """A row for each soil that drives adapted to: what it does at their ends, mean over them."""
    of_map = ((name, query.soils(of)) for name, of in (("true", terrain), ("wrong", wrong)))
    named = (*of_map, ("adapted", adapted.soils))
    felt = {name: jax.jit(partial(behaviour, params))(soils) for name, soils in named}
    rows = []
    for kind in np.flatnonzero(np.asarray(terrain.deformable)):
        on = adapted.accepted[:, -1, kind] >= LEAST
        if not on.any():
            continue
        counts = (x[on, -1, kind].sum() for x in (adapted.accepted, adapted.refused))
        row = {"soil": terrain.class_names[kind], "drives": str(on.sum())}
        row["measurements, refused"] = ", ".join(map(str, counts))
        for quantity, unit, i, scale in (("sinkage", "mm", 0, 1e3), ("pull", "kN", 1, 1e-3)):
            true, before = (scale * float(felt[name][i][kind]) for name in ("true", "wrong"))
            after = scale * np.asarray(felt["adapted"][i])[on, -1, kind]
            spread = f"{after.mean():.3g} ({after.min():.3g} to {after.max():.3g})"
            row[f"{quantity}, {unit}: true / wrong"] = f"{true:.3g} / {before:.3g}"
            row[f"{quantity}, {unit}: adapted"] = spread
        rows.append(row)
    return rows


def format_errors(found: Mapping[str, Mapping[str, tuple[int, Interval]]]) -> str:
    """A Markdown table, soils of the map a row, periods of the drive a column."""
    first = next(iter(found.values()))
    rows = [
        {"soils": name}
        | {
            f"{period} (n = {first[period][0]})": f"{x.mean:.3f} ({x.low:.3f}-{x.high:.3f})"
            for period, (_, x) in by_period.items()
        }
        for name, by_period in found.items()
    ]
    title = f"{HORIZON}-step position error on soil, m: mean and 95 % interval over drives"
    return f"{title}\n\n{format_rows(rows)}"


def format_rows(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table of rows with the same columns."""
    return markdown(list(rows[0]), (list(row.values()) for row in rows))


def _repeated(soils: Soil, times: int) -> Soil:
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (times, *x.shape)), soils)


def _period(i: int) -> str:
    low, high = PERIODS[i : i + 2]
    return f"{low:g} to {high:g} s" if np.isfinite(high) else f"after {low:g} s"
