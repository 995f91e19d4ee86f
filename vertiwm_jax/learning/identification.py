"""A vehicle's numbers found from its drives, with the built-in simulator as the model."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from operator import mul
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from vertiwm_jax import config as configuration
from vertiwm_jax.geometry import wrap
from vertiwm_jax.learning import windows
from vertiwm_jax.learning.dataset import FITTED, load_drives
from vertiwm_jax.learning.objectives import open_loop
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.mechanics import vehicle as vehicles
from vertiwm_jax.mechanics.simulator import Simulator, SimulatorParams, chrono_like
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig
from vertiwm_jax.precision import float32
from vertiwm_jax.terrain.map import TerrainMap

FREE = ("speed_gain", "wheel_torque", "brake_torque", "tyre_friction")
_CONTEXT = 8  # steps that settle the springs
_MOST_WINDOWS = 512
_MOST_TRIES = 12
_STEP = 0.02  # share by which numbers are changed to see what they do
_log = logging.getLogger(__name__)


@float32
def identify(
    drives: str | Path | Sequence[str | Path],
    vehicle: str | VehicleConfig = HMMWV,
    *,
    free: Sequence[str] = FREE,
    horizon: int = 16,
) -> VehicleConfig:
    """Finds numbers of a vehicle with which the simulator predicts its drives best.

    Each number is multiplied by a factor, which nonlinear least squares find. Windows with a crash
    count little (Cauchy's loss), and what drives tell nothing of stays as it is.

    Args:
        drives: a folder of drives, as `load_drives` reads them, or several.
        vehicle: numbers to begin with: of a shipped vehicle, of a YAML file, or as they
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
    configuration.expect_fields(free, VehicleConfig, where="free: ")
    recorded, terrain = load_drives(drives, "train", FITTED)
    recorded.expect_steered_by(begin)
    index = windows.index(recorded, terrain, _CONTEXT, horizon, horizon)
    every = -(-len(index.start) // _MOST_WINDOWS)
    chosen = windows.gather(recorded, index, np.arange(0, len(index.start), every))

    def changed(factors: np.ndarray) -> VehicleConfig:
        each = zip(free, factors.tolist(), strict=True)
        found = {name: jax.tree.map(partial(mul, by), getattr(begin, name)) for name, by in each}
        return replace(begin, **found)

    def misses(factors: np.ndarray) -> np.ndarray:
        params = chrono_like(changed(factors).vehicle)
        return np.asarray(_misses(params, terrain, chosen), float).ravel()

    def error(missed: np.ndarray) -> float:
        return float(np.linalg.norm(missed.reshape(-1, 4)[:, :3], axis=1).mean())

    missed = misses(np.ones(len(free)))
    _log.info("the simulator errs by %.3f m after %d steps", error(missed), horizon)
    fitted = least_squares(
        misses,
        np.ones(len(free)),
        bounds=(0, np.inf),
        loss="cauchy",
        f_scale=float(np.median(np.abs(missed))) + 1e-6,
        diff_step=_STEP,
        xtol=1e-3,
        ftol=1e-4,
        max_nfev=_MOST_TRIES,
    )
    found = changed(fitted.x)
    told = ", ".join(f"{name} {np.round(getattr(found, name), 4)}" for name in free)
    _log.info("  %.3f m: %s", error(fitted.fun), told)
    return found


@jax.jit
def _misses(params: SimulatorParams, terrain: TerrainMap, chosen: Windows) -> jax.Array:
    """`[N, 4]` how far off the last states are: m, and m at the reach of the axles for yaw."""

    def one(window: Windows) -> jax.Array:
        ground = terrain.select(window.world)
        states, _ = open_loop(Simulator(), params, ground, window)
        truth = window.state[-1]
        turn = wrap(states.rpy[-1, 2] - truth[5]) * params.vehicle.wheelbase
        return jnp.append(states.position[-1] - truth[:3], turn)

    missed = jax.lax.map(one, chosen, batch_size=64)
    return jnp.nan_to_num(missed, nan=1e3, posinf=1e3, neginf=-1e3)
