"""`vertiwm collect`: record drives in a simulator, to fit and to test models on."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal

import jax
import numpy as np
import tyro

from vertiwm_jax import atomic
from vertiwm_jax import config as configuration
from vertiwm_jax.cli import arguments
from vertiwm_jax.config import Bounds, ConfigError, Count, settings
from vertiwm_jax.env.agent import Policy
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.vehicle import HMMWV, Vehicle, VehicleConfig
from vertiwm_jax.models.registry import load_encoders
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.rl.policy import load_policy
from vertiwm_jax.runs import Progress
from vertiwm_jax.simulators import chrono, collection, excitation, processes
from vertiwm_jax.simulators.builtin import BuiltIn
from vertiwm_jax.simulators.chrono import Chrono
from vertiwm_jax.simulators.driving import Drive
from vertiwm_jax.simulators.protocol import SimulatorError
from vertiwm_jax.state import STEP_SECONDS
from vertiwm_jax.terrain import files, worlds
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.worlds import Difficulty, Kind, WorldConfig

SHORTEST = 0.8
"""Share of its time after which a drive that ended early is kept; others are tried again."""
ATTEMPTS = 6


@settings
class Collect:
    """Record drives of a vehicle in a simulator as `fit` and `evaluate` read them, a file a world.

    The same command goes on where it was stopped: worlds whose file is there are not driven again.
    """

    output: Path
    """Folder for the files; their maps are in its folder `maps`."""
    simulator: Literal["builtin", "chrono"] = "builtin"
    """What moves the vehicle; Chrono needs PyChrono, and has the HMMWV alone."""
    vehicle: str = HMMWV
    """Name of a vehicle that comes along, or a YAML file of one; drives are at its full size."""
    worlds: Path | None = None
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
    """Drives on each world; `fit` learns from the first 20, and tests on 22 to 24."""
    seconds: Annotated[float, Bounds(STEP_SECONDS)] = 25.0
    """Duration of a drive."""
    policy: Path | None = None
    """Run folder of a policy that drives from goal to goal; the paper's sinusoids by default."""
    seed: int = 0
    """Decides everything that is random."""
    jobs: Count = 1
    """Processes that simulate."""

    def check(self):
        if self.obstacles and not (self.worlds and self.simulator == "chrono"):
            raise ValueError("obstacles: are solid in Chrono alone, and are those of given worlds")
        if self.vehicle != HMMWV and self.simulator == "chrono":
            raise ValueError(f"vehicle: expected {HMMWV} in Chrono, found {self.vehicle}")
        WorldConfig(self.difficulties, self.kinds)

    @property
    def steps(self) -> int:
        """Steps of a drive that is not ended early."""
        return round(self.seconds / STEP_SECONDS)


@dataclass(frozen=True)
class Task:
    """One drive to record: number `drive` on the selected world of `terrain`, number `world`."""

    command: Collect
    vehicle: Vehicle
    learned: tuple[Policy, NavigationConfig, Encoders | None] | None
    terrain: TerrainMap
    world: int
    drive: int


def run(name: str, words: Sequence[str]) -> None:
    command = arguments.read(Collect, name, words, config=(tyro.conf.FlagConversionOff,))
    collect(command)
    print(f"the drives are in {command.output}; to fit the world model to them:")
    print(f"python -m vertiwm_jax.fit --data {command.output}")


def collect(command: Collect) -> None:
    """Records what the folder lacks, a world after the other."""
    if command.simulator == "chrono":
        chrono.modules()
    config = vehicle.load(command.vehicle)
    terrain, learned = _terrain(command, config.scale), _learned(command)
    _claim(command)
    missing = [w for w in range(terrain.worlds) if not _file(command, w).exists()]
    tasks = (
        Task(command, config.vehicle, learned, alone, world, drive)
        for world in missing
        for alone in [jax.device_get(terrain.subset(np.array([world])))]
        for drive in range(command.drives)
    )
    total = len(missing) * command.drives * command.steps
    print(f"{len(missing)} of {terrain.worlds} worlds are left", flush=True)
    began, done = time.monotonic(), 0
    with processes.simulating(command.jobs) as mapped, Progress(total, "steps") as progress:
        found = mapped(record, tasks)
        for world in missing:
            drives = []
            for drive in islice(found, command.drives):
                drives.append(drive)
                done += len(drive.control)
                progress.advance(command.steps, f"world {world}, drive {len(drives)}")
            alone = jax.device_get(terrain.subset(np.array([world])))
            _write(command, config, world, alone, drives)
    if done:
        print(f"{done:,} steps, {done / (time.monotonic() - began):,.0f} a second")


def record(task: Task) -> Drive:
    """The longest of a few attempts, of which the first that lasts is the last.

    `SimulatorError` if none of them does a single step.
    """
    command, tries = task.command, []
    terrain = jax.device_put(task.terrain)
    chrono_drives = command.simulator == "chrono"
    simulator = Chrono(terrain) if chrono_drives else BuiltIn(terrain, task.vehicle)
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([command.seed, task.world, task.drive, attempt])
        start = excitation.start(rng, terrain, command.seconds)
        if task.learned:
            pilot = collection.to_goals(*task.learned, task.vehicle, terrain, start, rng)
        else:
            pilot = excitation.sinusoids(rng, command.steps, float(task.vehicle.steering_limit))
        tries.append(collection.record(simulator, terrain, start, pilot, command.steps))
        if len(tries[-1].control) >= SHORTEST * command.steps:
            break
    longest = max(tries, key=lambda drive: len(drive.control))
    if not len(longest.control):
        raise SimulatorError(
            f"world {task.world}: drive {task.drive}: expected a step or more, found none in "
            f"{ATTEMPTS} attempts ({longest.ending})"
        )
    return longest


def _terrain(command: Collect, scale: float) -> TerrainMap:
    """All worlds to drive on."""
    if command.worlds:
        return files.load_map(command.worlds, scale=scale, obstacles=command.obstacles)
    config = WorldConfig(command.difficulties, command.kinds)
    count = command.repeats * len(command.difficulties) * len(command.kinds)
    return worlds.generate(jax.random.split(jax.random.key(command.seed), count), config, scale)


def _learned(command: Collect) -> tuple[Policy, NavigationConfig, Encoders | None] | None:
    """What the run has learned, in host memory, how it is to be driven, and what it sees by."""
    run = command.policy
    if run is None:
        return None
    policy = load_policy(run).on(vehicle.load(command.vehicle))
    seen_by = load_encoders(policy.config.weights) if policy.task.embeddings else None
    acting, seen_by = jax.device_get((policy.acting, seen_by))
    return acting, policy.task, seen_by


def _claim(command: Collect) -> None:
    """Notes in the folder what it is made by; `ConfigError` if it was made by something else."""
    file = command.output / "config.yaml"
    settings = replace(command, output=Path("."), jobs=1)
    if not file.exists():
        if command.output.is_dir() and any(command.output.iterdir()):
            raise ConfigError(f"{file}: expected a new folder, or one of this command")
        (command.output / "maps").mkdir(parents=True, exist_ok=True)
        atomic.write(file, configuration.dump(settings))
    before = configuration.load(Collect, file)
    for name in (field.name for field in fields(Collect)):
        was, asked = getattr(before, name), getattr(settings, name)
        if was != asked:
            raise ConfigError(f"{file}: {name}: expected {was} as before, found {asked}")


def _file(command: Collect, world: int) -> Path:
    return command.output / f"world_{world:03d}.npz"


def _write(
    command: Collect, vehicle: VehicleConfig, world: int, terrain: TerrainMap, drives: list[Drive]
) -> None:
    """The map, and then the drives, by which a world counts as done."""
    path = _file(command, world)
    files.save(terrain, path.parent / "maps" / path.name)
    meta = {
        "map": path.name,
        "simulator": command.simulator,
        "scale": vehicle.scale,
        "policy": str(command.policy) if command.policy else "sinusoids",
        "world": world,
        "seed": command.seed,
    }
    collection.write(path, drives, command.steps, meta, vehicle.vehicle)
