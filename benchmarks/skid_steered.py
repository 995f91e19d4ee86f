"""How well skid-steered robots are predicted for 1.6 s: real logs of a Husky and a Warthog.

`python -m benchmarks.skid_steered husky.npz warthog.npz` reads windows of 2 s at 20 Hz: `pose`
`[N, 40, 6]`, `command` and `wheel` `[N, 40, 2]` (left and right, rad/s), `imu` `[N, 40, 4]` (the
last is the yaw rate), `step` `[N]` and `meta` (wheel radius, wheelbase and track in m). Windows of
one `step` have the same command, so intervals draw steps, not windows. Poses come at about 10 Hz
and are held between: held ones are not counted where a state is estimated.

The simulator has the numbers of the robot's file in `configs/vehicles`, which `--fit` finds again,
within minutes: by least squares through it, with the first 30 windows, from guesses.
"""

import json
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from benchmarks._harness import Figures, parser, report
from vertiwm_jax.arrays import load_archive
from vertiwm_jax.dynamics import Dynamics, Params, rollout
from vertiwm_jax.evaluation.prediction import bootstrap
from vertiwm_jax.geometry import wrap
from vertiwm_jax.importers.commands import differential
from vertiwm_jax.mechanics import vehicle as vehicles
from vertiwm_jax.mechanics.kinematic import ConstantVelocity, DifferentialDrive, DifferentialParams
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import Skid, Vehicle
from vertiwm_jax.precision import float32
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap

START, STEPS = 7, 16
"""Sample at which predictions begin, and steps of 0.1 s that they last."""
SAMPLE_SECONDS = 0.05
FITTED = 30
"""Windows that are fitted to, 60 s; the others are predicted."""
POSE_NOISE = 0.04  # m, of a pose from lidar
WHEEL_NOISE = 0.15  # m/s, by which a vehicle is slower than 0.9 times its wheels
WHEEL_SHARE = 0.9
DRIFT = 0.3  # m/s sideways that are usual
GUESSES = {
    "husky": (0.6, 0.3, 1.5, 4.0, 15.0, 0.2, 0.5, 9.0, 0.0),
    "warthog": (0.6, 1.0, 1.0, 1.0, 150.0, 0.4, 0.8, 17.0, 0.0),
}
"""Where `--fit` begins, by robot: the numbers that `VehicleNumbers` lists."""
DEVIATIONS = np.array([0.3, 0.7, 0.3, 0.7, 0.5, 0.7, 0.7, 0.5, 1.0])
"""How far off guesses usually are: of the logarithms, of the place of the mass in tenths of the
wheelbase."""
NOISE = {"husky": 0.15, "warthog": 0.35}
"""m by which predictions err after 1.6 s."""
FREE = "speed_gain", "turn_gain", "speed_lag", "turn_lag", "offset", "drift"


@dataclass(frozen=True)
class Logs:
    """N windows of T samples of one robot.

    xy: `[N, T, 2]` m; yaw: `[N, T]` rad; command, wheel: `[N, T, 2]` m/s and rad/s of wheels that
    do not slip; gyro: `[N, T]` rad/s; step: `[N]`; geometry: wheelbase, track and wheel radius, m.
    """

    xy: np.ndarray
    yaw: np.ndarray
    command: np.ndarray
    wheel: np.ndarray
    gyro: np.ndarray
    step: np.ndarray
    geometry: tuple[float, float, float]
    name: str

    @classmethod
    def of(cls, path: Path) -> "Logs":
        """Of a file of windows."""
        found = load_archive(path, ("pose", "command", "wheel", "imu", "step", "meta"))
        robot = json.loads(str(found["meta"]))["vehicle"]
        pose = found["pose"].astype(float)
        radius, track = robot["wheel_radius"], robot["track"]

        def driven(wheels: np.ndarray) -> np.ndarray:
            return np.stack(differential(*np.moveaxis(radius * wheels, -1, 0), track), axis=-1)

        return cls(
            xy=pose[..., :2],
            yaw=np.unwrap(pose[..., 5], axis=1),
            command=driven(found["command"].astype(float)),
            wheel=driven(found["wheel"].astype(float)),
            gyro=found["imu"][..., 3].astype(float),
            step=found["step"],
            geometry=(robot["wheelbase"], track, radius),
            name=robot["name"],
        )

    @cached_property
    def fresh(self) -> np.ndarray:
        """`[N, T]` bool, whether a pose is another than that of the sample before."""
        moved = (np.diff(self.xy, axis=1) != 0).any(axis=2) | (np.diff(self.yaw, axis=1) != 0)
        return np.pad(moved, [(0, 0), (1, 0)], constant_values=True)

    def some(self, rows: np.ndarray) -> "Logs":
        """Some of the windows."""
        arrays = {k: x[rows] for k, x in vars(self).items() if isinstance(x, np.ndarray)}
        arrays.pop("fresh", None)
        return Logs(**arrays, geometry=self.geometry, name=self.name)

    @property
    def commands(self) -> Command:
        """`[N, 16]` means over each step that is predicted."""
        steps = self.command[:, START : START + 2 * STEPS].reshape(-1, STEPS, 2, 2)
        return Command.from_vector(jnp.asarray(steps.mean(axis=2), jnp.float32))


def estimated(logs: Logs, sensors: bool) -> VehicleState:
    """`[N, 3]` the states at sample 7, on level ground, from samples 0 to 7.

    A twist that is constant in the body is fitted to the poses that are no held ones. With sensors
    the gyroscope turns the body instead, wheels say how its speed changed, and about what it is.
    """
    seen = slice(0, START + 1)
    fresh, wheel = logs.fresh[:, seen], logs.wheel[:, seen, 0]
    past = SAMPLE_SECONDS * (np.arange(START + 1) - START)
    found = []

    def since(rate: np.ndarray) -> np.ndarray:
        """`[8]` integrals from sample 7 back to each, of rates at the samples."""
        between = SAMPLE_SECONDS * (rate[1:] + rate[:-1]) / 2
        return -np.append(np.cumsum(between[::-1])[::-1], 0)

    for xy, yaw, gyro, rim, new in zip(
        logs.xy[:, seen], logs.yaw[:, seen], logs.gyro[:, seen], wheel, fresh, strict=True
    ):
        if sensors:
            turned, yaw_rate = since(gyro), gyro[-3:].mean()
            now = np.mean((yaw - turned)[new])
        else:
            yaw_rate, now = np.polyfit(past[new], yaw[new], 1) if new.sum() > 1 else (0, yaw[-1])
            turned = yaw_rate * past
        cos, sin = np.cos(now + turned), np.sin(now + turned)
        gained = WHEEL_SHARE * (rim - rim[-1]) * sensors
        one, none = np.ones(new.sum()), np.zeros(new.sum())
        ahead = [one, none, since(cos)[new], -since(sin)[new]]
        left = [none, one, since(sin)[new], since(cos)[new]]
        moved = np.stack([since(cos * gained)[new], since(sin * gained)[new]])
        rows = np.concatenate([np.stack(ahead, 1), np.stack(left, 1)]) / POSE_NOISE
        told = (xy[new].T - moved).ravel() / POSE_NOISE
        prior = WHEEL_NOISE if sensors else np.inf
        rows = np.vstack([rows, [0, 0, 1 / prior, 0], [0, 0, 0, 1 / DRIFT]])
        told = np.append(told, [WHEEL_SHARE * rim[-1] / prior, 0])
        x, y, speed, drift = np.linalg.lstsq(rows, told, rcond=None)[0]
        found.append([x, y, 0, 0, 0, now, speed, drift, 0, 0, 0, yaw_rate])
    return VehicleState.from_vector(jnp.asarray(found, jnp.float32))


@float32
@partial(jax.jit, static_argnums=0)
def predicted(
    model: Dynamics, params: Params, ground: TerrainMap, state: VehicleState, commands: Command
) -> VehicleState:
    """`[N, 3]` last states of 1.6 s."""
    paths = jax.vmap(lambda s, c: rollout(model, params, ground, s, c))(state, commands)
    return jax.tree.map(lambda x: x[:, -1], paths)


def errors(last: VehicleState, logs: Logs) -> np.ndarray:
    """`[N, 3]` m and rad by which predictions end apart from the logged x, y and yaw."""
    end = START + 2 * STEPS
    xy = np.asarray(last.position[:, :2]) - logs.xy[:, end]
    return np.column_stack([xy, wrap(np.asarray(last.rpy[:, 2]) - logs.yaw[:, end])])


def fitted(
    params: DifferentialParams, ground: TerrainMap, state: VehicleState, logs: Logs
) -> DifferentialParams:
    """The differential drive with the `FREE` numbers that predict windows best."""
    reach = np.array([1, 1, float(params.wheelbase + params.track) / 2])

    def of(numbers: np.ndarray) -> DifferentialParams:
        values = {name: jnp.float32(x) for name, x in zip(FREE, numbers, strict=True)}
        return replace(params, **values)

    def misses(numbers: np.ndarray) -> np.ndarray:
        last = predicted(DifferentialDrive(), of(numbers), ground, state, logs.commands)
        return (errors(last, logs) * reach).ravel()

    begin, low = [0.8, 0.3, 0.3, 0.3, 0.0, 0.1], [0, 0, 0.01, 0.01, -1, -1]
    found = least_squares(
        misses, begin, bounds=(low, [2, 2, 3, 3, 1, 1]), loss="soft_l1", f_scale=0.2, diff_step=0.01
    )
    return of(found.x)


def numbered(numbers: ArrayLike, vehicle: Vehicle) -> Vehicle:
    """The vehicle with `[9]` numbers: friction, slip speed, gain, pedal per speed, torque, lags of
    speed and turn, largest wheel speed, and the place of the mass ahead of the middle, m."""
    friction, slip, gain, pedal, torque, of_speed, of_turn, limit, ahead = jnp.asarray(numbers)
    return replace(
        vehicle,
        tyre_friction=friction,
        speed_gain=pedal,
        wheel_torque=torque,
        brake_torque=torque,
        wheel_speed_limit=limit,
        centre_of_mass=jnp.asarray(vehicle.centre_of_mass).at[0].set(ahead),
        skid=Skid(gain, of_speed, of_turn, slip),
    )


@float32
@jax.jit
def simulated(
    vehicle: Vehicle, ground: TerrainMap, state: VehicleState, wheel: jax.Array, commands: Command
) -> VehicleState:
    """`[N, 16, 3]` states in the built-in simulator, from measured wheel speeds `[N, 2]`."""
    simulator, params = Simulator(), chrono_like(vehicle)

    def one(state: VehicleState, wheel: jax.Array, commands: Command) -> VehicleState:
        height = state.position.at[2].set(vehicle.ride_height)
        state = replace(state, position=height)
        history = simulator.init(params, ground, state)
        rim = wheel[0] - wheel[1] * vehicle.wheel_position[:, 1]
        gain = vehicle.skid.gain if vehicle.skid is not None else 1.0
        told = wheel / gain
        spin = rim / vehicle.wheel_radius
        history = replace(history, wheel_speed=spin, speed=told[0], steering=told[1])
        return rollout(simulator, params, ground, state, commands, history)

    return jax.vmap(one)(state, wheel, commands)


def fitted_vehicle(
    vehicle: Vehicle, ground: TerrainMap, state: VehicleState, logs: Logs
) -> tuple[np.ndarray, np.ndarray]:
    """`[9]` numbers of `numbered` that predict windows best, and 90 % intervals `[9, 2]`."""
    guess, steps = np.array(GUESSES[logs.name]), np.array([4, 8, 12, 16])
    truth = np.dstack([logs.xy, logs.yaw])[:, START + 2 * steps]
    reach = 1.0 if logs.name == "warthog" else 0.7
    weight = 1 / (NOISE[logs.name] * (0.15 + 0.85 * steps / STEPS))
    weight = weight[:, None] * np.array([1, 1, reach])
    wheel = jnp.asarray(logs.wheel[:, START], jnp.float32)

    def of(changes: jax.Array) -> jax.Array:
        ahead = guess[-1] + changes[-1] * logs.geometry[0] / 10
        return jnp.append(guess[:-1] * jnp.exp(changes[:-1]), ahead)

    @jax.jit
    def misses(changes: jax.Array) -> jax.Array:
        found = simulated(numbered(of(changes), vehicle), ground, state, wheel, logs.commands)
        xy, yaw = found.position[:, steps - 1, :2], found.rpy[:, steps - 1, 2]
        off = jnp.dstack([xy - truth[..., :2], wrap(yaw - truth[..., 2])])
        return (off * weight).ravel()

    slopes = jax.jit(jax.jacfwd(misses))

    def residual(changes: np.ndarray) -> np.ndarray:
        return np.append(np.asarray(misses(jnp.float32(changes))), changes / DEVIATIONS)

    def jacobian(changes: np.ndarray) -> np.ndarray:
        return np.vstack([np.asarray(slopes(jnp.float32(changes))), np.diag(1 / DEVIATIONS)])

    found = least_squares(
        residual, 0 * guess, jacobian, loss="soft_l1", max_nfev=25, xtol=1e-3, ftol=1e-4
    )
    half = 1.645 * np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    ends = [np.asarray(of(jnp.float32(found.x + side * half))) for side in (-1, 1)]
    return np.asarray(of(jnp.float32(found.x))), np.stack(ends, axis=1)


def figures(error: np.ndarray, logs: Logs) -> Figures:
    """Mean errors with 95 % intervals over steps; also where the last pose is no held one."""
    row: dict[str, float] = {}
    sizes = {
        "position_m": np.linalg.norm(error[:, :2], axis=1),
        "yaw_rad": np.abs(error[:, 2]),
    }
    for name, size in sizes.items():
        interval = bootstrap(size, logs.step)
        row |= {name: interval.mean, f"{name}_low": interval.low, f"{name}_high": interval.high}
    row["position_m_fresh"] = float(sizes["position_m"][logs.fresh[:, START + 2 * STEPS]].mean())
    return row


def rows(path: Path, fit: bool = False) -> dict[str, Figures]:
    """Figures of each model, by name; but for the last of each state, on windows not fitted to."""
    logs = Logs.of(path)
    ground = TerrainMap.from_array(np.zeros((9, 9)), "concrete", resolution=8.0)
    ideal = DifferentialParams(*map(jnp.float32, (*logs.geometry, 1, 1, 0.01, 0.01, 0, 0)))
    some, rest = np.arange(FITTED), np.arange(FITTED, len(logs.step))
    first, others = logs.some(some), logs.some(rest)
    drive, made = DifferentialDrive(), dict[str, Figures]()
    for told, sensors in {"poses": False, "poses, wheels, gyroscope": True}.items():
        begin, begins = estimated(first, sensors), estimated(others, sensors)
        every = estimated(logs, sensors)
        on_all = fitted(ideal, ground, every, logs)
        cases: dict[str, tuple[Dynamics, Params, VehicleState, Logs]] = {
            "constant velocity": (ConstantVelocity(), None, begins, others),
            "differential drive without slip": (drive, ideal, begins, others),
            "differential drive": (drive, fitted(ideal, ground, begin, first), begins, others),
            "differential drive, fitted to all": (drive, on_all, every, logs),
        }
        for name, (model, params, state, tested) in cases.items():
            last = predicted(model, params, ground, state, tested.commands)
            made[f"{path.stem}: {name} ({told})"] = figures(errors(last, tested), tested)
        if sensors and logs.name in GUESSES:
            robot = replace(vehicles.load(logs.name), scale=1.0).vehicle
            if fit:
                numbers, ends = fitted_vehicle(robot, ground, begin, first)
                robot = numbered(numbers, robot)
                for number, (low, high) in zip(numbers, ends, strict=True):
                    print(f"{number:.4g} ({low:.4g} to {high:.4g})")
            wheel = jnp.asarray(others.wheel[:, START], jnp.float32)
            driven = simulated(robot, ground, begins, wheel, others.commands)
            last = jax.tree.map(lambda x: x[:, -1], driven)
            made[f"{path.stem}: simulator ({told})"] = figures(errors(last, others), others)
    return made


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("logs", nargs="+", type=Path, help="files of windows, one a robot")
    arguments.add_argument("--fit", action="store_true", help="find the robots' numbers again")
    chosen = arguments.parse_args()
    results = {k: row for path in chosen.logs for k, row in rows(path, chosen.fit).items()}
    report("skid_steered", results, chosen.json)


if __name__ == "__main__":
    main()
