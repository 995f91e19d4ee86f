"""A vehicle's numbers found from its drives, with the built-in simulator as the model."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import mul
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from vertiwm_jax import config as configuration
from vertiwm_jax import geometry
from vertiwm_jax.config import ConfigError
from vertiwm_jax.geometry import wrap
from vertiwm_jax.importers import delay as delays
from vertiwm_jax.importers.delay import Response
from vertiwm_jax.learning import windows
from vertiwm_jax.learning.dataset import FITTED, Drives, SplitConfig, load_drives
from vertiwm_jax.learning.objectives import open_loop
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.mechanics import vehicle as vehicles
from vertiwm_jax.mechanics.simulator import Simulator, SimulatorParams, chrono_like
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig
from vertiwm_jax.precision import float32
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain.map import TerrainMap

PRIORS: Mapping[str, float] = {
    "inertia": 0.3,
    "spring": 0.3,
    "damper": 0.5,
    "steering_rate": 0.5,
    "speed_gain": 0.5,
    "wheel_torque": 0.5,
    "wheel_power": 0.5,
    "brake_torque": 0.5,
    "tyre_friction": 0.2,
}
"""Standard deviations of the logarithm of what a person gives for a number, by field."""
FREE = tuple(PRIORS)
MASS = 0.1
"""The same of the mass, which drives do not tell: only how large forces are beside it."""
OF_MASS = ("inertia", "spring", "damper", "wheel_torque", "wheel_power", "brake_torque")
"""Numbers that drives tell as their ratio to the mass."""
_OTHERS = 0.3  # of fields that are not among these
_CONTEXT = 32  # steps until wheels turn and stand as they did
_DELAY = 0.05  # s, standard deviation of a delay that is estimated beforehand
_MOST_WINDOWS = 512
_STEP = 0.1  # deviations by which numbers are changed to see what they do
_ROUNDS = 4  # of weighing windows
_CRASH = 2.4  # misses, in typical ones, from which a window counts little (Cauchy)
NINETY = 1.645
"""Standard deviations on each side of a 90 % interval."""
_NOISE = (0.005, 0.002, 0.01, 0.01)  # m, rad, m/s and rad/s that recorded states may be off
_DRAWS = 6  # of such noise
_SURE = 0.06  # standard deviation of a logarithm that is left however many drives there are
_STUCK = 0.1  # share of the commanded way, below which a vehicle is stuck
_FLOOR = 1e-3  # m, below which no miss is told from another
Misses = Callable[[np.ndarray], np.ndarray]
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Number:
    """A number of the vehicle as a factor to what was given for it.

    factor, low, high: what was found, with its 90 % interval. prior: such an interval before, from
        1 / prior to prior. ratio: the interval of its ratio to the mass, as a factor, where that
        is what drives tell; it is narrower, as the mass is taken as given.
    """

    name: str
    factor: float
    low: float
    high: float
    prior: float
    ratio: tuple[float, float] | None

    @property
    def told(self) -> float:
        """Share of the prior's width that the drives took away; 0 if they tell nothing of it."""
        return max(0.0, 1 - float(np.log(self.high / self.low) / (2 * np.log(self.prior))))


@dataclass(frozen=True)
class Identified:
    """What drives tell of a vehicle.

    vehicle: its numbers. delay: after which commands act, s at full size as in the drives, with its
        90 % interval.
    before, after: `[K]` mean position error, m, after each step of prediction, by the numbers that
        were given and by those that were found.
    """

    vehicle: VehicleConfig
    numbers: tuple[Number, ...]
    delay: tuple[float, float, float]
    before: np.ndarray
    after: np.ndarray


@float32
def identify(
    drives: str | Path | Sequence[str | Path],
    vehicle: str | VehicleConfig = HMMWV,
    *,
    free: Sequence[str] = FREE,
    horizon: int = 16,
    splits: SplitConfig = FITTED,
) -> Identified:
    """Finds numbers of a vehicle with which the simulator predicts its drives best.

    Each number is multiplied by a factor near 1 (`PRIORS`), which nonlinear least squares find.
    Windows with a crash count little, those of a stuck vehicle do not, and what drives tell nothing
    of stays as it is. Intervals hold if the simulator can be right: what it lacks, other numbers
    make up for. Poses and commands tell forces and moments of inertia only beside the mass, which
    is taken as given. The delay after which commands act is found too, from the estimate of
    `importers.delay` on.

    Args:
        drives: a folder of drives, as `load_drives` reads them, or several.
        vehicle: numbers to begin with: of a shipped vehicle, of a YAML file, or as they
            are.
        free: which fields of `VehicleConfig` to find; pairs get one factor.
        horizon: steps of 0.1 s that are predicted.
        splits: how drives are shared out whose files do not say it; those to train are used.

    Returns:
        The vehicle (`config.save` writes it as a YAML file), and how well its numbers are known.

    Raises:
        ConfigError: there is no such vehicle or field.
        DataError, MapError: drives or their maps are malformed, or all drives are too short, or the
            vehicle is stuck in all of them.
    """
    begin = vehicles.load(vehicle) if isinstance(vehicle, str) else vehicle
    configuration.expect_fields(free, VehicleConfig, where="free: ")
    for name in free:
        value = getattr(begin, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if not all(isinstance(x, float) for x in numbers):
            raise ConfigError(f"free: {name}: expected a field of numbers, found {value!r}")
    recorded, terrain = load_drives(drives, "train", splits, wheels=False)
    recorded.expect_steered_by(begin)
    context = min(_CONTEXT, max(int(np.max(recorded.length)) - horizon, 0))
    index = windows.index(recorded, terrain, context, horizon, horizon)
    rows = np.flatnonzero(_moves(windows.gather(recorded, index)))
    if not len(rows):
        raise DataError(f"{drives}: expected drives in which the vehicle moves, found none")
    rows = rows[:: -(-len(rows) // _MOST_WINDOWS)]
    chosen = windows.gather(recorded, index, rows)
    late = _estimated_delay(recorded)
    deviation = np.array([PRIORS.get(name, _OTHERS) for name in free])

    def changed(factors: np.ndarray) -> VehicleConfig:
        each = zip(free, factors.tolist(), strict=True)
        found = {name: jax.tree.map(partial(mul, by), getattr(begin, name)) for name, by in each}
        return replace(begin, **found)

    def predicted(away: np.ndarray, of: Windows = chosen) -> tuple[np.ndarray, np.ndarray]:
        """Misses, and position errors, of numbers so many deviations away from the prior."""
        params = chrono_like(changed(np.exp(deviation * away[:-1])).vehicle)
        missed, error = _misses(params, terrain, of, _delay(late, away[-1]))
        return np.asarray(missed, float), np.asarray(error)

    nudged = [_nudged(chosen, seed) for seed in range(_DRAWS)]

    def blur(away: np.ndarray) -> np.ndarray:
        return np.std([predicted(away, of)[0] for of in nudged], axis=0)

    away, cov = _posterior(lambda away: predicted(away)[0], blur, len(free) + 1)
    factors, deviations = np.exp(deviation * away[:-1]), np.sqrt(np.diag(cov))
    before, after = (predicted(x)[1].mean(axis=0) for x in (np.zeros(len(away)), away))
    _log.info("the simulator errs by %.3f m after %d steps", before[-1], horizon)
    _log.info("  %.3f m with the numbers that were found", after[-1])
    told = list[Number]()
    for name, factor, prior, left in zip(free, factors, deviation, deviations[:-1], strict=True):
        own, of_mass = np.hypot(prior * left, _SURE), name in OF_MASS
        wide = _interval(factor, np.hypot(own, MASS) if of_mass else own)
        ratio = _interval(factor, own) if of_mass else None
        told.append(Number(name, float(factor), *wide, float(np.exp(NINETY * prior)), ratio))
    ends = away[-1] + NINETY * deviations[-1] * np.array([0, -1, 1])
    found, low, high = (_delay(late, x) for x in ends.tolist())
    return Identified(changed(factors), tuple(told), (found, low, high), before, after)


def _moves(of: Windows) -> np.ndarray:
    """`[N]` in which windows the vehicle moves, or is to stand.

    One that is stuck tells what it hangs on, and not what it is.
    """
    way = windows.way(np.asarray(of.state)[:, of.context :, :3])
    return way >= _STUCK * of.commanded_way


def _estimated_delay(drives: Drives) -> float:
    """How late the vehicle of drives acts on its commands, s; 0 if they do not tell."""
    responses = []
    for state, control, length in zip(drives.state, drives.control, drives.length, strict=True):
        time = np.arange(int(length) + 1) * STEP_SECONDS
        state, control = np.asarray(state)[: len(time)], np.asarray(control)[: len(time) - 1]
        told = time[:-1], control, drives.turn
        responses.append(Response(time, state[:, 6], state[:, 11], *told))
    found = delays.estimate(responses)
    return 0.0 if found is None else found.seconds


def _delay(estimated: float, away: float) -> float:
    """The delay, s, so many deviations away from its estimate."""
    return max(estimated + _DELAY * away, 0.0)


def _nudged(chosen: Windows, seed: int) -> Windows:
    """The windows as other noise would have made them."""
    noise = np.random.default_rng(seed).normal(0, np.repeat(_NOISE, 3), chosen.state.shape)
    return replace(chosen, state=chosen.state + noise.astype(np.float32))


def _posterior(misses: Misses, blur: Misses, numbers: int) -> tuple[np.ndarray, np.ndarray]:
    """What is most likely, `[P]` deviations away from the prior, and its covariance `[P, P]`.

    misses: of P deviations, `[N, C]` of windows. blur: of them, what noise makes of misses.
    """
    found, prior = np.zeros(numbers), np.eye(numbers)
    for _ in range(_ROUNDS):
        missed = misses(found)
        scale = blur(found) + _FLOOR
        scale = scale * max(1.4826 * np.median(np.abs(missed / scale)), _FLOOR)
        typical = np.mean((missed / scale) ** 2, axis=1)
        # All misses of a window count as one: they hang together.
        weight = 1 / np.sqrt(missed.shape[1] * (1 + typical / _CRASH**2))[:, None] / scale

        def weighted(away: np.ndarray, weight: np.ndarray = weight) -> np.ndarray:
            return weight * misses(away)

        def slopes(away: np.ndarray, weighted=weighted) -> np.ndarray:
            steps = _STEP * prior
            found = [weighted(away + step) - weighted(away - step) for step in steps]
            return np.stack(found, axis=-1) / (2 * _STEP)

        def all_slopes(away: np.ndarray, slopes=slopes) -> np.ndarray:
            return np.vstack([slopes(away).reshape(-1, numbers), prior])

        found = least_squares(
            lambda away, weighted=weighted: np.append(weighted(away), away),
            found,
            all_slopes,  # pyright: ignore[reportArgumentType]
            xtol=1e-4,
            ftol=1e-5,
            max_nfev=30,
        ).x
    slope = slopes(found).reshape(-1, numbers)
    return found, np.linalg.inv(slope.T @ slope + prior)


def _interval(factor: float, deviation: float) -> tuple[float, float]:
    """The ends of a 90 % interval, where the logarithm has this standard deviation."""
    wide = np.exp(NINETY * deviation)
    return float(factor / wide), float(factor * wide)


@jax.jit
def _misses(
    params: SimulatorParams, terrain: TerrainMap, chosen: Windows, delay: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """`[N, 12]` how far off states are, and `[N, K]` position errors, m.

    Of a quarter of the steps, of half of them and of all: forward, to the left and up as the
    vehicle started, m, and yaw, m at the reach of the axles.
    """

    def one(window: Windows) -> tuple[jax.Array, jax.Array]:
        ground = terrain.select(window.world)
        window = replace(window, control=_late(window.control, delay))
        states, _ = open_loop(Simulator(), params, ground, window)
        truth = window.state[window.context + 1 :]
        away = states.position - truth[:, :3]
        yaw = window.state[window.context, 3:6] * jnp.array([0.0, 0.0, 1.0])
        heading = geometry.rotation_from_rpy(yaw)
        turn = wrap(states.rpy[:, 2] - truth[:, 5]) * params.vehicle.wheelbase
        missed = jnp.column_stack([away @ heading.as_matrix(), turn])
        steps = len(truth)
        ends = np.array([steps // 4, steps // 2, steps]).clip(1) - 1
        return missed[ends].ravel(), jnp.linalg.norm(away, axis=-1)

    found = jax.lax.map(one, chosen, batch_size=64)
    return jax.tree.map(lambda x: jnp.nan_to_num(x, nan=1e3, posinf=1e3, neginf=-1e3), found)


def _late(control: jax.Array, seconds: jax.Array) -> jax.Array:
    """Commands `[T, 2]`, each held for a step, as means over steps that begin so much earlier."""
    late = seconds / STEP_SECONDS
    steps, whole = jnp.arange(len(control)), jnp.floor(late).astype(jnp.int32)
    first, second = (control[jnp.maximum(steps - whole - i, 0)] for i in (0, 1))
    return first + (late - whole) * (second - first)
