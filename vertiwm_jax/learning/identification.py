"""A vehicle's numbers found from its drives, with the built-in simulator as the model."""

import logging
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import config as configuration
from vertiwm_jax.config import ConfigError
from vertiwm_jax.geometry import wrap
from vertiwm_jax.learning import windows
from vertiwm_jax.learning.dataset import load_drives
from vertiwm_jax.learning.objectives import open_loop
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.mechanics import vehicle as vehicles
from vertiwm_jax.mechanics.simulator import Simulator, SimulatorParams, chrono_like
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig
from vertiwm_jax.terrain.map import TerrainMap

FREE = ("speed_gain", "wheel_torque", "brake_torque", "tyre_friction")
_CONTEXT = 8  # steps that settle the springs
_MOST_WINDOWS = 512
_ITERATIONS = 6
_STEP = 0.02  # of a logarithm, for differences
_LARGEST = 0.5  # of a logarithm, in one iteration
_PRIOR = 1e-3  # how much the numbers that are given count, beside the share of all windows
_log = logging.getLogger(__name__)


def identify(
    drives: str | Path | Sequence[str | Path],
    vehicle: str | VehicleConfig = HMMWV,
    *,
    free: Sequence[str] = FREE,
    horizon: int = 16,
) -> VehicleConfig:
    """Finds numbers of a vehicle with which the simulator predicts its drives best.

    Each number is multiplied by a factor, which damped Gauss-Newton steps find. What drives tell
    nothing of stays as it is. Progress is logged.

    Args:
        drives: a folder of drives, as `load_drives` reads them, or several.
        vehicle: numbers to begin with: of a vehicle that comes along, of a YAML file, or as they
            are.
        free: which fields of `VehicleConfig` to find; pairs get one factor.
        horizon: steps of 0.1 s that are predicted.

    Returns:
        The vehicle with these numbers; `config.save` writes it as a YAML file.

    Raises:
        ConfigError: there is no such vehicle or field.
        DataError, MapError: drives or their maps are malformed, or all drives are too short.
    """
    begin = vehicles.load(vehicle) if isinstance(vehicle, str) else vehicle
    known = [field.name for field in fields(VehicleConfig)]
    for name in free:
        if name not in known:
            raise ConfigError(f"free: {name}: expected {configuration.choices(name, known)}")
    recorded, terrain = load_drives(drives, "train")
    index = windows.index(recorded, terrain, _CONTEXT, horizon, horizon)
    every = -(-len(index.start) // _MOST_WINDOWS)
    chosen = windows.gather(recorded, jax.tree.map(lambda x: x[::every], index))

    def misses(factors: np.ndarray) -> np.ndarray:
        params = chrono_like(_changed(begin, free, factors).vehicle)
        return np.asarray(_misses(params, terrain, chosen))

    factors = np.zeros(len(free))
    found = misses(factors)
    scale = float(np.median(np.abs(found))) + 1e-6
    _log.info("the simulator errs by %.3f m after %d steps", _error(found), horizon)
    for _ in range(_ITERATIONS):
        shifted = [misses(factors + _STEP * row) for row in np.eye(len(free))]
        slopes = np.stack([(other - found).ravel() for other in shifted], axis=1) / _STEP
        # As Cauchy's loss weighs them, so that windows with a crash count little.
        weight = 1 / (1 + (found.ravel() / scale) ** 2)
        curvature = slopes.T @ (weight[:, None] * slopes)
        damping = _PRIOR * (np.trace(curvature) / len(free) + 1e-9) * np.eye(len(free))
        step = np.linalg.solve(curvature + damping, -slopes.T @ (weight * found.ravel()))
        step = np.clip(step, -_LARGEST, _LARGEST)
        for half in (1.0, 0.5, 0.25):
            tried = misses(factors + half * step)
            if _loss(tried, scale) < _loss(found, scale):
                factors, found = factors + half * step, tried
                break
        else:
            break
        _log.info("  %.3f m: %s", _error(found), _told(_changed(begin, free, factors), free))
    return _changed(begin, free, factors)


@jax.jit
def _misses(params: SimulatorParams, terrain: TerrainMap, chosen: Windows) -> jax.Array:
    """`[N, 4]` how far off the last states are: m, and m at the reach of the axles for yaw."""

    def one(window: Windows) -> jax.Array:
        ground = terrain.select(window.world)
        states, _ = open_loop(Simulator(), params, ground, window, lambda _: None)
        truth = window.state[-1]
        turn = wrap(states.rpy[-1, 2] - truth[5]) * params.vehicle.wheelbase
        return jnp.append(states.position[-1] - truth[:3], turn)

    missed = jax.lax.map(one, chosen, batch_size=64)
    return jnp.nan_to_num(missed, nan=1e3, posinf=1e3, neginf=-1e3)


def _changed(begin: VehicleConfig, free: Sequence[str], factors: np.ndarray) -> VehicleConfig:
    def times(value: float | tuple[float, ...], factor: float) -> float | tuple[float, ...]:
        if isinstance(value, tuple):
            return tuple(factor * x for x in value)
        return factor * value

    grown = zip(free, np.exp(factors).tolist(), strict=True)
    return replace(begin, **{name: times(getattr(begin, name), factor) for name, factor in grown})


def _loss(missed: np.ndarray, scale: float) -> float:
    return float(np.log1p((missed / scale) ** 2).sum())


def _error(missed: np.ndarray) -> float:
    return float(np.linalg.norm(missed[:, :3], axis=1).mean())


def _told(found: VehicleConfig, free: Sequence[str]) -> str:
    return ", ".join(f"{name} {np.round(getattr(found, name), 4)}" for name in free)
