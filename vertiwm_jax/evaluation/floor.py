"""How far apart drives end that begin next to each other: what no model can predict better than."""

import itertools
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax import atomic
from vertiwm_jax.config import AtLeastOne, Count, CountOrZero, settings
from vertiwm_jax.evaluation import yardsticks
from vertiwm_jax.evaluation.prediction import TestWindows
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import Drives, SplitConfig, WheelSignals
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.vehicle import HMMWV, VehicleConfig
from vertiwm_jax.runs import Progress
from vertiwm_jax.simulators import chrono, collection, processes
from vertiwm_jax.simulators.builtin import BuiltIn
from vertiwm_jax.simulators.chrono import Chrono
from vertiwm_jax.simulators.excitation import MARGIN, within
from vertiwm_jax.simulators.protocol import Drive, drive
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap

APART = 1e-3
"""m, and m/s."""
_Task = tuple[TerrainMap, np.ndarray, np.ndarray, np.ndarray]


@settings
class FloorTest:
    """How far apart drives end that are 1 mm and 1 mm/s apart when a prediction begins.

    A simulator drives the recorded commands twice from where the drive begins, at rest. After the
    context the second vehicle is moved to a side that is drawn, and pushed to another. No model
    that is told where a vehicle is to the millimeter predicts better than these errors.
    """

    data: tuple[Path, ...]
    """Folders of `.npz` files of drives, with the maps they name."""
    simulator: Literal["builtin", "chrono"] = "builtin"
    """What moves the vehicle; Chrono needs PyChrono."""
    vehicle: str = HMMWV
    """Name of a shipped vehicle, or a YAML file of one."""
    split: dataset.Split = "test"
    """Which of the drives."""
    splits: SplitConfig = dataset.FITTED
    """How drives are shared out, and which worlds are left out of fits."""
    every: Count = 1
    """1 drives all of these, 2 every other one, and so on."""
    context: CountOrZero = 16
    """Steps before the vehicles part."""
    horizons: Annotated[tuple[Count, ...], AtLeastOne] = (16, 50, 100)
    """Steps after which their distance is told."""
    seed: CountOrZero = 0
    """Decides to which sides vehicles are moved and pushed."""
    jobs: Count = 1
    """Processes that simulate."""
    json: Path | None = None
    """File for the errors as a JSON list of rows, as of `evaluate prediction`."""

    def run(self) -> str:
        """Drives, and writes what is asked for; returns the tables as Markdown."""
        driven = vehicle.load(self.vehicle)
        if self.simulator == "chrono":
            chrono.expect(driven)
        recorded, terrain = dataset.load_drives(self.data, self.split, self.splits)
        recorded.expect_steered_by(driven)
        steps, rng = self.context + max(self.horizons), np.random.default_rng(self.seed)
        chosen = range(0, len(recorded.length), self.every)
        tasks = [_task(recorded, terrain, number, steps, rng) for number in chosen]
        pairs = []
        with processes.simulating(self.jobs) as mapped, Progress(len(tasks), "drives") as progress:
            for pair in mapped(partial(twice, self.simulator, driven, self.context), tasks):
                pairs.append(pair)
                progress.advance()
        lasting = [i for i, pair in enumerate(pairs) if all(len(one.control) for one in pair)]
        if not lasting:
            raise DataError("drives: expected places to start on their maps, found none")
        first, second = (
            collection.arrays([pairs[i][which] for i in lasting], steps) for which in (0, 1)
        )
        drives = Drives(
            state=first["state"],
            control=first["control"],
            length=np.minimum(first["length"], second["length"]),
            wheel_class=first["wheel_class"],
            world=np.asarray(recorded.world)[[chosen[i] for i in lasting]],
            wheels=WheelSignals(),
            vehicles=(self.vehicle,) * terrain.worlds,
        )
        every, tests = TestWindows.nested(drives, terrain, self.context, self.horizons, steps)
        moved, tables, found = second["state"][every.drive, self.context + 1 :], [], []
        name = f"{self.simulator}, 1 mm and 1 mm/s apart"
        for horizon, (rows, test) in tests.items():
            predicted = VehicleState.from_vector(jnp.asarray(moved[rows, :horizon]))
            made = yardsticks.rows(name, predicted, test, self.split)
            tables.append(yardsticks.table(made))
            found += made
        if self.json:
            atomic.write(self.json, yardsticks.json_text(found))
        return "\n\n".join(tables)


def _task(
    recorded: Drives, terrain: TerrainMap, number: int, steps: int, rng: np.random.Generator
) -> _Task:
    """What `twice` drives of one recorded drive."""
    moved, pushed = rng.uniform(-np.pi, np.pi, 2)
    sides = [np.cos(moved), np.sin(moved), 0, np.cos(pushed), np.sin(pushed), 0]
    alone = jax.device_get(terrain.subset(np.array([recorded.world[number]])))
    control = np.asarray(recorded.control)[number, : min(steps, int(recorded.length[number]))]
    return alone, np.asarray(recorded.state)[number, 0, [0, 1, 5]], control, APART * np.array(sides)


def twice(simulator: str, driven: VehicleConfig, context: int, task: _Task) -> tuple[Drive, Drive]:
    """The same drive twice, of which the second is moved and pushed after the context.

    task: a map with the world selected; x, y, m, and yaw, rad, of the start; commands `[T, 2]`;
    and how far the second is moved, m, and pushed, m/s, `[6]` in the frame of the world.
    """
    terrain, start, control, offset = task
    terrain = jax.device_put(terrain)
    in_chrono = simulator == "chrono"
    moved = Chrono(terrain, driven) if in_chrono else BuiltIn(terrain, driven.vehicle)
    over = partial(collection.ending, *within(terrain, MARGIN))

    def driving(offset: np.ndarray) -> Drive:
        steps = itertools.count()

        def pilot(state: np.ndarray) -> np.ndarray:
            step = next(steps)
            if step == context:
                moved.push(offset[:3], offset[3:])
            return control[step]

        return drive(moved, start.tolist(), pilot, len(control), over)

    return driving(np.zeros(6)), driving(offset)
