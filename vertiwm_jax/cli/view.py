"""`vertiwm view`: a drive in three dimensions and over time, or as a movie."""

import subprocess
import sys
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import tyro

from vertiwm_jax import figures
from vertiwm_jax.cli import arguments
from vertiwm_jax.config import ConfigError, CountOrZero, settings
from vertiwm_jax.env import suites
from vertiwm_jax.env.suites import Suite
from vertiwm_jax.errors import UserError
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.vehicle import HMMWV
from vertiwm_jax.models.registry import ModelName, load_model
from vertiwm_jax.rl import experiment
from vertiwm_jax.terrain.files import load_map
from vertiwm_jax.viewing import driven, movie, recorded
from vertiwm_jax.viewing.scene import Scene


@settings
class View:
    """Show maps, how a policy drives a task, or a recorded drive with what a model predicts."""

    source: tyro.conf.Positional[Path]
    """An .npz map or a folder of maps, the run folder of a policy's training, or an .npz file of
    recorded drives."""
    model: ModelName = "vertiwm"
    """What a policy drives in, or whose predictions are shown beside a recorded drive."""
    weights: Path | None = None
    """Folder of a fitted model, instead of the one that comes with the package."""
    vehicle: str | None = None
    """Name or YAML file of the vehicle; by default that of the policy's training, or the HMMWV."""
    suite: Suite | None = None
    """Kind of procedural worlds to drive a policy on; all that were held out by default."""
    task: CountOrZero | None = None
    """Which of the tasks there; the first by default."""
    seed: CountOrZero | None = None
    """Which of the policies that the run trained side by side; the first by default."""
    drive: CountOrZero | None = None
    """Which drive of a file; the first by default."""
    output: Path | None = None
    """File of the recording, or of the picture of maps; beside what is shown by default."""
    open: bool = False
    """Whether to open the recording in the rerun viewer."""
    movie: Path | None = None
    """A .gif or .mp4 file to write instead of a recording."""

    def check(self):
        if self.movie and self.movie.suffix not in movie.WRITERS:
            found = self.movie.suffix or "none"
            raise ValueError(f"movie: expected the ending .gif or .mp4, found {found}")
        if self.movie and (self.output or self.open):
            raise ValueError("movie: is written instead of a recording, leave out output and open")


def run(name: str, words: Sequence[str]) -> None:
    command = arguments.read(View, name, words)
    if _are_maps(command.source):
        print(f"the picture is {_picture(command)}")
        return
    path = view(command)
    if command.movie:
        print(f"the movie is {path}")
        return
    print(f"the recording is {path}; to look at it:\nrerun {path}")
    if command.open:
        status = subprocess.call([sys.executable, "-m", "rerun", str(path)])
        if status:
            raise UserError(f"{path}: the rerun viewer ended with status {status}")


def _are_maps(source: Path) -> bool:
    """Whether it is a map, or a folder of maps, and not a run or a file of drives."""
    if source.is_dir():
        files = [*source.glob("*.npz"), *source.glob("envs")]
        return bool(files) and not (source / "config.yaml").exists()
    if not zipfile.is_zipfile(source):
        return False
    with zipfile.ZipFile(source) as file:
        return "elevation.npy" in file.namelist() and "state.npy" not in file.namelist()


def _picture(command: View) -> Path:
    """Draws the maps from above; the file."""
    source = command.source
    path = command.output or (
        source / "maps.png" if source.is_dir() else source.with_suffix(".png")
    )
    files = sorted(source.glob("*.npz")) if source.is_dir() else [source]
    figures.save(load_map(source).plot([file.stem for file in files] or None), path)
    return path


def view(command: View) -> Path:
    """Writes what was asked for, as a whole or not at all; the file."""
    of_run = command.source.is_dir()
    path = command.movie or command.output or (_beside_run if of_run else _beside_file)(command)
    write = _writer(command, path)
    scene = (_driven if of_run else _recorded)(command)
    print(scene.title, flush=True)
    write(scene, path)
    return path


def _writer(command: View, path: Path) -> Callable[[Scene, Path], None]:
    """What writes the file; `ConfigError`, which names it, without the package for that."""
    if command.movie:
        movie.check(path)
        return movie.write
    try:
        from vertiwm_jax.viewing.recording import write
    except ImportError as error:
        raise ConfigError(
            f"{path}: expected the package rerun-sdk to write it, found: {error}; "
            'pip install "vertiwm-jax[view]"'
        ) from None
    return write


def _beside_run(command: View) -> Path:
    task = f"{command.suite or 'held-out'}-{command.task or 0}"
    return command.source / f"{task}-{command.model}.rrd"


def _beside_file(command: View) -> Path:
    return command.source.with_name(f"{command.source.stem}-drive-{command.drive or 0}.rrd")


def _driven(command: View) -> Scene:
    """The policy of a run on its experiment."""
    run, number, seed = command.source, command.task or 0, command.seed or 0
    if command.drive is not None:
        raise ConfigError(f"{run}: drive: is of a file of drives, found the folder of a run")
    config = replace(experiment.load(run / "config.yaml"), planning=None)
    if command.suite:
        config = replace(config, worlds=None)
        config = replace(config, ground=replace(config.ground, suites=(command.suite,)))
    if command.weights:
        config = replace(config, weights=command.weights)
    if command.vehicle is not None:
        config = replace(config, vehicle=command.vehicle)
    terrain = experiment.held_out(config)
    policies = experiment.learned(config, run)
    pool = suites.test_tasks(config.ground, terrain)
    for name, found, count in (("task", number, len(pool.world)), ("seed", seed, len(policies))):
        if not 0 <= found < count:
            raise ConfigError(f"{run}: {name}: expected 0 to {count - 1}, found {found}")
    alone = jax.tree.map(lambda x: x[number : number + 1], pool)
    test = experiment.environment(config, command.model, terrain, alone)
    name, policy = list(policies.items())[seed]
    title = f"{name} in {command.model}"
    scene = driven.drive(test.env, test.params, policy, config.key("testing"), title)
    return replace(scene, vehicle=config.driven.vehicle)


def _recorded(command: View) -> Scene:
    """The drive of a file beside a model's predictions."""
    file, number = command.source, command.drive or 0
    for name in ("suite", "task", "seed"):
        if getattr(command, name) is not None:
            raise ConfigError(
                f"{file}: {name}: is of a policy, expected the folder of a run, found none"
            )
    shown = vehicle.load(command.vehicle or HMMWV).vehicle
    model = load_model(command.model, command.weights, vehicle=shown)
    return replace(recorded.load(file, number, command.model, *model), vehicle=shown)
