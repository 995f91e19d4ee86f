"""How well vehicles are predicted that no fit has learned from, by what is known of them.

`python -m benchmarks.unseen_vehicles data/vehicles --vehicles uaz` reads the files
`<vehicle>_<kind>_<0 or 1>.npz`. World 1 of each kind is predicted: by the model of any vehicle with
nothing but what the file says of the vehicle; after it was adapted to 60 s of world 0; and by what
is fitted to these 60 s alone. `--whole` adds what is fitted to all of world 0 (an hour or more a
vehicle on two cores).
"""

import logging
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks import recurrent_baseline
from benchmarks._harness import Figures, parser, report
from vertiwm_jax import config as configuration
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.evaluation import prediction, yardsticks
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import schema
from vertiwm_jax.learning.dataset import SplitConfig, load_drives
from vertiwm_jax.learning.experiment import FitConfig, fit
from vertiwm_jax.learning.identification import identify
from vertiwm_jax.learning.pipeline import KINDS
from vertiwm_jax.mechanics.kinematic import KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.measured import measured
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import VehicleConfig
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.models.registry import load_model, moving

TRAIN, VALIDATION = 150, 50
"""Steps of each of three drives, one on each kind of ground: 60 s."""
ALONE = 600
"""Updates of what is fitted to these alone."""
WHOLE = 8_000
"""Updates of NeSAM on world 0, a third of the default, as there are 20 minutes of drives."""


def gather_logs(data: Path, vehicle: str, folder: Path) -> VehicleConfig:
    """Writes 60 s of world 0 of each kind to a folder; what its files say of the vehicle."""
    ends = (0, TRAIN), (TRAIN, TRAIN + VALIDATION)
    for kind in KINDS:
        source = data / f"{vehicle}_{kind}_0.npz"
        arrays, meta = schema.read(source)
        row = np.flatnonzero(arrays["length"] >= TRAIN + VALIDATION)[0]
        state, control = arrays["state"][row], arrays["control"][row]
        parts = [schema.drive(state[a : b + 1], control[a:b]) for a, b in ends]
        found = schema.join(parts) | {"split": np.array(["train", "validation"])}
        wheels = meta["vehicle"]["wheels_in_body_xy"]
        schema.write(folder / source.name, found, {"map": meta["map"]}, wheels)
    return measured(meta["vehicle"], f"{source}: meta.vehicle")


def models(options: Namespace, vehicle: str) -> Iterator[tuple[str, Dynamics, Params]]:
    """Every row of the table: its name, the model, and its parameters with the vehicle."""
    folder = options.runs / vehicle
    logs = link(options.data, [], folder / "logs")
    described = gather_logs(options.data, vehicle, logs)
    yield "bicycle", KinematicBicycle(), bicycle_of(described.vehicle)
    yield "simulator", Simulator(), chrono_like(described.vehicle)
    for name in ("vertiwm", "nesam"):
        yield f"{name}, described", *load_model(name, options.model, vehicle=described.vehicle)

    identified = identify(logs, described).vehicle
    yield "simulator, identified", Simulator(), chrono_like(identified.vehicle)
    model, params = load_model("vertiwm", options.model)
    before, after = (moving(params, each.vehicle) for each in (described, identified))
    yield "vertiwm, identified", model, after
    gained = prediction.gain(model, before, after, *load_drives(logs, "train", wheels=False))
    file = folder / "vehicle.yaml"
    file.write_text(configuration.dump(identified if gained.low > 0 else described))
    given: dict[str, Any] = {"vehicle": str(file), "runs": folder}
    yield "vertiwm, adapted", *fit(logs, config="adapt", start=options.model, **given)
    yield "NeSAM, of 60 s alone", *fit(logs, **alone(), **given)
    yield "recurrent network, of 60 s alone", *recurrent_baseline.fitted([logs], ALONE, folder)
    if options.whole:
        names = [f"{vehicle}_{kind}_0.npz" for kind in KINDS]
        world = link(options.data, names, folder / "world")
        usual = configuration.load(FitConfig, configuration.find("fit_chrono")).nesam
        nesam = replace(usual, rollouts=replace(usual.rollouts, updates=WHOLE))
        file.write_text(configuration.dump(described))
        # Here, drives of this vehicle are learned from.
        given |= {"config": "fit_chrono", "splits": SplitConfig(), "nesam": nesam}
        yield "vertiwm, of world 0", *fit(world, **given)
        newest = max(folder.glob("fit-*"), key=lambda run: run.stat().st_mtime)
        yield "nesam, of world 0", *load_model("nesam", newest / "model")


def alone() -> dict[str, Any]:
    """Settings of a fit of NeSAM without the Transformer, to few drives."""
    usual = configuration.load(FitConfig, configuration.find("fit_chrono"))
    unused = replace(usual.soil, updates=0)
    rollouts = replace(usual.nesam.rollouts, updates=ALONE)
    nesam = replace(usual.nesam, autoencoders=unused, rollouts=rollouts)
    return {"model": ModelConfig(parts=("nesam",)), "nesam": nesam, "soil": unused}


def predicted(options: Namespace, vehicle: str) -> Iterator[tuple[str, Figures]]:
    """Errors after 16 steps on world 1, by model."""
    with TemporaryDirectory() as folder:
        link(options.data, [f"{vehicle}_{kind}_1.npz" for kind in KINDS], Path(folder))
        drives, terrain = load_drives(folder, "all", wheels=False)
    test = TestWindows.of(drives, terrain, context=16, horizon=16, stride=16)
    for name, dynamics, params in models(options, vehicle):
        states = prediction.predict(dynamics, params, test).states
        rows = yardsticks.rows(name, states, test, "all")
        every = {(row.subset, row.speed_bin): row for row in rows}
        whole = every["all", None]
        told = {"position_m": whole.position_m, "low_m": whole.position_m_low}
        told |= {"high_m": whole.position_m_high, "heading_rad": whole.heading_rad}
        for speed in yardsticks.SPEEDS:
            row = every.get(("all", speed))
            if row is not None and row.share_of_way is not None:
                told[f"share of way, {speed} m/s"] = row.share_of_way
        yield f"{vehicle}: {name}", told


def link(data: Path, names: list[str], folder: Path) -> Path:
    """A folder with these files of drives, if any, and the maps of all; it."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("maps", *names):
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to((data / name).resolve())
    return folder


def main() -> None:
    options = parser(__doc__)
    options.add_argument("data", type=Path)
    options.add_argument("--model", default="any_vehicle", help="folder of a model of any vehicle")
    options.add_argument("--vehicles", nargs="+", default=["fam_006", "fam_009", "uaz"])
    options.add_argument("--whole", action="store_true")
    options.add_argument("--runs", type=Path, default=Path("runs/unseen_vehicles"))
    chosen = options.parse_args()
    logging.basicConfig(level="INFO", format="%(message)s")
    results = {}
    for vehicle in chosen.vehicles:
        for name, figures in predicted(chosen, vehicle):
            print(name, f"{figures['position_m']:.3f} m", flush=True)
            results[name] = figures
    report("unseen_vehicles", results, chosen.json)


if __name__ == "__main__":
    main()
