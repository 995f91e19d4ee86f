"""Drives that are recorded in a simulator, and the files that keep them."""

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import atomic
from vertiwm_jax import config as configuration
from vertiwm_jax.config import Bounds, ConfigError, Count, CountOrZero, settings
from vertiwm_jax.env.agent import Policy, Reactive
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.suites import Tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.learning import schema
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.vehicle import HMMWV, Vehicle, VehicleConfig
from vertiwm_jax.models.registry import load_encoders
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.rl.policy import load_policy
from vertiwm_jax.runs import Progress
from vertiwm_jax.simulators import chrono, excitation, processes
from vertiwm_jax.simulators.builtin import BuiltIn
from vertiwm_jax.simulators.chrono import Chrono
from vertiwm_jax.simulators.excitation import MARGIN, within
from vertiwm_jax.simulators.following import AgentPilot, Followed
from vertiwm_jax.simulators.protocol import Drive, Ending, SimulatorError, drive
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import files, worlds
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.worlds import Difficulty, Kind, WorldConfig

_log = logging.getLogger(__name__)

LEAST_UPRIGHT = 0.3
"""Cosine of the tilt below which a vehicle has rolled over."""
LARGEST_SPEED = 30.0
"""m/s, beyond which a simulation has diverged."""
SHORTEST = 0.8
"""Share of its time after which a drive that ended early is kept; others are tried again."""
ATTEMPTS = 6


@settings
class CollectConfig:
    """Record drives of a vehicle in a simulator as `fit` and `evaluate` read them, a file a world.

    The same command goes on where it was stopped: worlds whose file is there are not driven again.
    """

    output: Path
    """Folder for the files; their maps are in its folder `maps`."""
    simulator: Literal["builtin", "chrono"] = "builtin"
    """What moves the vehicle; Chrono needs PyChrono, and has the HMMWV alone."""
    vehicle: str = HMMWV
    """Name of a shipped vehicle, or a YAML file of one; drives are at its full size."""
    terrain: Path | None = None
    """A Verti-Bench checkout or a folder of .npz maps, to drive on all of them."""
    obstacles: bool = False
    """Whether the rocks and trees of these maps stand there, in Chrono."""
    kinds: tuple[Kind, ...] = ("rigid", "deformable", "mixed")
    """Ground of procedural worlds, unless maps are given."""
    difficulties: tuple[Difficulty, ...] = ("low", "mid", "high")
    """How steep they are; there is one world of each kind and difficulty."""
    repeats: Count = 1
    """How many of each."""
    drives: Count = 25
    """Drives on each world."""
    seconds: Annotated[float, Bounds("at least 0.1", lambda x: x >= STEP_SECONDS)] = 25.0
    """Duration of a drive."""
    policy: Path | None = None
    """Run folder of a policy that drives from goal to goal; the paper's sinusoids by default."""
    seed: CountOrZero = 0
    """Decides everything that is random."""
    jobs: Count = 1
    """Processes that simulate."""

    def check(self):
        if self.obstacles and not (self.terrain and self.simulator == "chrono"):
            raise ValueError("obstacles: are solid in Chrono alone, and are those of given worlds")
        WorldConfig(self.difficulties, self.kinds)

    @property
    def steps(self) -> int:
        """Steps of a drive that is not ended early."""
        return round(self.seconds / STEP_SECONDS)


Learned = tuple[Policy, NavigationConfig, Encoders | None]
"""A policy, the task that it has learned, and what it sees the ground by, if it does."""


def collect(config: CollectConfig) -> None:
    """Records what the folder lacks, a world after the other."""
    driven = vehicle.load(config.vehicle)
    if config.simulator == "chrono":
        chrono.expect(driven)
    _expect(config)
    learned = _learned(config, driven)
    terrain = _terrain(config, driven.scale)
    _claim(config)
    paths = [config.output / f"world_{world:03d}.npz" for world in range(terrain.worlds)]
    missing = [world for world, path in enumerate(paths) if not path.exists()]
    tasks = (
        (alone, world, number)
        for world in missing
        # Without its place, by which it would be compiled anew.
        for alone in [jax.device_get(replace(terrain.subset(np.array([world])), middles=()))]
        for number in range(config.drives)
    )
    total = len(missing) * config.drives * config.steps
    _log.info("%d of %d worlds are left", len(missing), terrain.worlds)
    began, done = time.monotonic(), 0
    with processes.simulating(config.jobs) as mapped, Progress(total, "steps") as progress:
        found = mapped(partial(record, config, driven, learned), tasks)
        for world in missing:
            drives = []
            for one in islice(found, config.drives):
                drives.append(one)
                done += len(one.control)
                progress.advance(config.steps, f"world {world}, drive {len(drives)}")
            path = paths[world]
            files.save(terrain.select(jnp.int32(world)), path.parent / "maps" / path.name)
            meta = {
                "map": path.name,
                "simulator": config.simulator,
                "scale": driven.scale,
                "policy": str(config.policy) if config.policy else "sinusoids",
                "world": world,
                "seed": config.seed,
            }
            # Last, because by its file a world counts as done.
            wheels = driven.vehicle.wheel_position
            recorded = schema.in_file(arrays(drives, config.steps), terrain.offset(world))
            schema.write(path, recorded, meta, wheels, driven.turn)
    if done:
        _log.info("%s steps, %.0f a second", f"{done:,}", done / (time.monotonic() - began))


def record(
    config: CollectConfig,
    driven: VehicleConfig,
    learned: Learned | None,
    task: tuple[TerrainMap, int, int],
) -> Drive:
    """The longest of a few attempts at a drive, of which the first that lasts is the last.

    task: a map with the world selected, and the numbers of the world and of the drive.
    `SimulatorError` if no attempt does a single step.
    """
    terrain, world, number = task
    terrain, tries = jax.device_put(terrain), []
    over = partial(ending, *within(terrain, MARGIN))
    in_chrono, numbers = config.simulator == "chrono", driven.vehicle
    simulator = Chrono(terrain, driven) if in_chrono else BuiltIn(terrain, numbers)
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([config.seed, world, number, attempt])
        start = excitation.start(rng, terrain, config.seconds)
        if learned:
            pilot = to_goals(learned, numbers, terrain, start, rng)
        else:
            pilot = excitation.sinusoids(rng, config.steps, float(numbers.steering_limit))
        tries.append(drive(simulator, start, pilot, config.steps, over))
        if len(tries[-1].control) >= SHORTEST * config.steps:
            break
    longest = max(tries, key=lambda one: len(one.control))
    if not len(longest.control):
        raise SimulatorError(
            f"world {world}: drive {number}: expected a step or more, found none in {ATTEMPTS} "
            f"attempts ({longest.ending})"
        )
    return longest


def _terrain(config: CollectConfig, scale: float) -> TerrainMap:
    """All worlds to drive on."""
    if config.terrain:
        least = excitation.SMALLEST
        return files.load_map(config.terrain, scale=scale, obstacles=config.obstacles, least=least)
    count = config.repeats * len(config.difficulties) * len(config.kinds)
    drawn = WorldConfig(config.difficulties, config.kinds)
    return worlds.make_worlds(count, config.seed, drawn, scale=scale)


def _learned(config: CollectConfig, driven: VehicleConfig) -> Learned | None:
    """What the run has learned, in host memory."""
    if config.policy is None:
        return None
    policy = load_policy(config.policy).on(driven)
    seen_by = load_encoders(policy.config.weights) if policy.task.embeddings else None
    acting, seen_by = jax.device_get((policy.acting, seen_by))
    return acting, policy.task, seen_by


def _as_kept(config: CollectConfig) -> tuple[Path, CollectConfig]:
    """What notes what a folder is made by, and what it notes."""
    return config.output / "config.yaml", replace(config, output=Path("."), jobs=1)


def _claim(config: CollectConfig) -> None:
    """Notes in the folder what it is made by."""
    file, asked = _as_kept(config)
    (config.output / "maps").mkdir(parents=True, exist_ok=True)
    atomic.write(file, configuration.dump(asked))


def _expect(config: CollectConfig) -> None:
    """Raises `WriteError`, or `ConfigError` if the folder was made by something else."""
    atomic.expect_folder(config.output)
    file, asked = _as_kept(config)
    if not file.exists():
        if config.output.is_dir() and any(config.output.iterdir()):
            raise ConfigError(f"{file}: expected a new folder, or one of this command")
        return
    before = configuration.load(CollectConfig, file)
    for name, found in vars(asked).items():
        was = getattr(before, name)
        if was != found:
            raise ConfigError(f"{file}: {name}: expected {was} as before, found {found}")


def to_goals(
    learned: Learned,
    driven: Vehicle,
    terrain: TerrainMap,
    start: Sequence[float],
    rng: np.random.Generator,
) -> AgentPilot:
    """A policy as the pilot of a drive from goal to goal on the selected world.

    start: x, y, m, and yaw, rad; rng: draws the goals.
    """
    policy, config, encoders = learned
    env = NavigationEnv(Followed(), replace(config, settle_steps=0))
    next_goal = partial(excitation.next_goal, rng, terrain)
    place = jnp.asarray([start], jnp.float32)
    goal = jnp.asarray(next_goal(np.asarray(place[0, :2]))[None, :2])
    one = Tasks(jnp.reshape(terrain.world, 1), place[:, :2], place[:, 2], goal)
    task = env.make_params(jnp.zeros(12), terrain, one, driven, encoders)
    at_start = jax.tree.map(lambda x: x[0], task.starts)
    # No learned policy is random.
    return AgentPilot(env, task, Reactive(policy), at_start, jax.random.key(0), next_goal)


def arrays(drives: Sequence[Drive], steps: int) -> dict[str, np.ndarray]:
    """K drives as arrays of the schema, each filled up to `steps`, and how each of them ended."""
    parts = []
    for one in drives:
        seen = jax.tree.map(lambda *x: np.stack(x), *one.observations)
        known = {name: x for name, x in vars(seen.wheels).items() if x is not None}
        parts.append(schema.drive(seen.state, one.control, wheel_class=seen.wheel_class, **known))
    return {**schema.join(parts, steps), "ending": np.array([one.ending for one in drives])}


def ending(low: np.ndarray, high: np.ndarray, state: np.ndarray) -> Ending | None:
    """Why a drive cannot go on, if it cannot; low, high: `[2]` m, where it may be."""
    if not np.isfinite(state).all() or np.linalg.norm(state[6:9]) > LARGEST_SPEED:
        return "diverged"
    if ((state[:2] < low) | (state[:2] > high)).any():
        return "left the map"
    if np.cos(state[3]) * np.cos(state[4]) < LEAST_UPRIGHT:
        return "rolled over"
    return None
