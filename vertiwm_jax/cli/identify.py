"""`vertiwm identify`: numbers of a vehicle from its drives."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from vertiwm_jax import atomic, figures
from vertiwm_jax import config as configuration
from vertiwm_jax.cli import arguments
from vertiwm_jax.config import AtLeastOne, ConfigError, Count, settings
from vertiwm_jax.evaluation import plots, prediction
from vertiwm_jax.evaluation.tables import Row, markdown
from vertiwm_jax.importers.imports import import_drives
from vertiwm_jax.learning import experiment, identification
from vertiwm_jax.learning.dataset import FITTED, SplitConfig, load_drives
from vertiwm_jax.learning.experiment import FitConfig
from vertiwm_jax.learning.identification import MASS, Identified
from vertiwm_jax.mechanics import vehicle as vehicles
from vertiwm_jax.mechanics.vehicle import HMMWV
from vertiwm_jax.models.registry import load_model, moving
from vertiwm_jax.state import STEP_SECONDS


@settings
class Identify:
    """Find numbers of a vehicle with which the built-in simulator predicts its drives best, and how
    well drives tell them; and adapt a model to it."""

    drives: tyro.conf.Positional[Annotated[tuple[Path, ...], AtLeastOne]]
    """Folders of drives, as `collect` and `import_drives` write them; or, with `settings`, logs."""
    output: Path
    """YAML file of the vehicle to write, for `--vehicle` of other commands."""
    settings: Path | None = None
    """What is given are logs, which this file describes to `import_drives`. Their drives are
    written to a folder beside `output`, whose name ends in `.drives`."""
    map: Path | None = None
    """The ground of logs, as of `import_drives`."""
    vehicle: str = HMMWV
    """Numbers to begin with: the name of a shipped vehicle, or a YAML file of one."""
    free: Annotated[tuple[str, ...], AtLeastOne] = identification.FREE
    """Which of its numbers to find."""
    horizon: Count = 16
    """Steps of 0.1 s that are predicted."""
    splits: SplitConfig = FITTED
    """How drives are shared out whose files do not say what they are for; those to train are used,
    and to adapt also those for validation."""
    model: Path | None = None
    """Folder of a model, or `any_vehicle`, to adapt to the vehicle by `configs/adapt.yaml`. It gets
    the numbers that were found if it predicts the drives better with them, else the given ones."""
    runs: Path = Path("runs")
    """Folder in which the folder of the adapted model is made."""
    picture: Path | None = None
    """File of a picture to write: numbers with their intervals, and errors before and after."""


def run(name: str, words: list[str]) -> None:
    command = arguments.read(Identify, name, words)
    for path in (command.output, command.picture):
        if path is not None:
            atomic.expect_file(path)
    if command.map is not None and command.settings is None:
        raise ConfigError("map: expected with settings, as drives have maps of their own")
    adapt = configuration.load(FitConfig, configuration.find("adapt"))
    if command.model is not None:  # That there is none is to be said now.
        adapt = replace(adapt, start=command.model, runs=command.runs, splits=command.splits)
        experiment.started(adapt)
    drives = command.drives
    if command.settings is not None:
        folder = command.output.with_suffix(".drives")
        print(import_drives(drives, folder, command.settings, map=command.map))
        drives = (folder,)
    asked = {"free": command.free, "horizon": command.horizon, "splits": command.splits}
    found = identification.identify(drives, command.vehicle, **asked)
    atomic.write(command.output, configuration.dump(found.vehicle))
    if command.picture is not None:
        figures.save(plots.identified(found), command.picture)
    print("\n".join(_told(found)))
    model, vehicle = "--model builtin", str(command.output)
    print(f"the vehicle is in {vehicle}")
    if command.model is not None:
        moved, params = load_model("vertiwm", command.model)
        given = vehicles.load(command.vehicle)
        before, after = (moving(params, each.vehicle) for each in (given, found.vehicle))
        recorded = load_drives(drives, "train", command.splits, wheels=False)
        gained = prediction.gain(moved, before, after, *recorded)
        better = gained.low > 0
        vehicle = vehicle if better else command.vehicle
        print(
            f"The model errs by {gained} m less with what was found than with what was given; "
            f"it is adapted with what was {'found' if better else 'given'}."
        )
        run = experiment.run(replace(adapt, data=drives, vehicle=vehicle))
        model = f"--weights {run / 'model'}"
    print("to train with it:")
    print(f"python -m vertiwm_jax.ppo {model} --vehicle {vehicle}")


def _told(found: Identified) -> list[str]:
    rows: list[Row] = [
        {
            "number": number.name,
            "factor to what was given": f"{number.factor:.2f} ({number.low:.2f}-{number.high:.2f})",
            "given": f"1.00 ({1 / number.prior:.2f}-{number.prior:.2f})",
            "beside the mass": "{:.2f}-{:.2f}".format(*number.ratio) if number.ratio else "",
            "told by drives": "hardly" if number.told < 1 / 3 else f"{number.told:.0%}",
        }
        for number in found.numbers
    ]
    seconds = len(found.before) * STEP_SECONDS
    delay, low, high = found.delay
    beside = (
        " Drives tell forces and moments of inertia only beside the mass, which is taken as given, "
        f"give or take {np.expm1(identification.NINETY * MASS):.0%}."
    )
    return [
        markdown(rows),
        "",
        "90 % intervals." + (beside if any(number.ratio for number in found.numbers) else ""),
        f"Commands act {delay:.2f} s late ({low:.2f}-{high:.2f}).",
        f"Position error after {seconds:.1f} s: {found.before[-1]:.3f} m with what was given, "
        f"{found.after[-1]:.3f} m with what was found.",
    ]
