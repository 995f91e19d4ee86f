"""`vertiwm view`: a drive in three dimensions and over time, or as a movie."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import tyro

from vertiwm_jax import atomic
from vertiwm_jax.cli import arguments
from vertiwm_jax.config import ConfigError, CountOrZero, settings
from vertiwm_jax.env.suites import Suite
from vertiwm_jax.errors import UserError, needs
from vertiwm_jax.evaluation.report import NavigationTest
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.models.registry import ModelName, load_model
from vertiwm_jax.viewing import drives, maps, movie
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
    """Folder of a fitted model, instead of one that comes with the package."""
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
    """A .gif file to write instead of a recording."""

    def check(self):
        if self.movie and self.movie.suffix != ".gif":
            found = self.movie.suffix or "none"
            raise ValueError(f"movie: expected the ending .gif, found {found}")
        if self.movie and (self.output or self.open):
            raise ValueError("movie: is written instead of a recording, leave out output and open")


def run(name: str, words: list[str]) -> None:
    command = arguments.read(View, name, words)
    source = command.source
    if not source.exists():
        raise ConfigError(f"{source}: expected maps, a run or a file of drives, found none")
    of_maps = maps.are_maps(source)
    beside = maps.beside(source) if of_maps else _beside(command)
    path = command.movie or command.output or beside
    atomic.expect_file(path)
    if of_maps:
        maps.draw(source, path)
        print(f"the picture is {path}")
        return
    write = movie.write
    if not command.movie:
        with needs("rerun-sdk", "view", path):
            from vertiwm_jax.viewing.recording import write
    scene = _scene(command)
    print(scene.title, flush=True)
    write(scene, path)
    if command.movie:
        print(f"the movie is {path}")
        return
    print(f"the recording is {path}; to look at it:\nrerun {path}")
    if command.open:
        status = subprocess.call([sys.executable, "-m", "rerun", str(path)])
        if status:
            raise UserError(f"{path}: the rerun viewer ended with status {status}")


def _beside(command: View) -> Path:
    """Where a recording is, unless another file was asked for."""
    source = command.source
    if source.is_dir():
        task = f"{command.suite or 'held-out'}-{command.task or 0}"
        return source / f"{task}-{command.model}.rrd"
    return source.with_name(f"{source.stem}-drive-{command.drive or 0}.rrd")


def _scene(command: View) -> Scene:
    """A policy's drive, or a recorded one."""
    source, of_run = command.source, command.source.is_dir()
    others = ("drive",) if of_run else ("suite", "task", "seed")
    for name in others:
        if getattr(command, name) is not None:
            kind = "a file of drives" if of_run else "a policy"
            raise ConfigError(f"{source}: {name}: is of {kind}")
    if of_run:
        suites = (command.suite,) if command.suite else ()
        asked = NavigationTest(source, vehicle=command.vehicle, suites=suites, planning=False)
        which = command.model, command.weights, command.task or 0, command.seed or 0
        return drives.of_policy(source, asked, *which)
    shown = vehicle.load(command.vehicle or vehicle.HMMWV).vehicle
    model = load_model(command.model, command.weights, vehicle=shown)
    scene = drives.recorded(source, command.drive or 0, command.model, *model)
    return replace(scene, vehicle=shown)
