"""The whole of Verti-WM from recorded drives: what is fitted, in which order, to which drives.

Every stage is a `stages.fit` in a folder of its own inside that of the run.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Self

import jax
import numpy as np

from vertiwm_jax.config import CountOrZero, settings
from vertiwm_jax.dynamics import Params
from vertiwm_jax.learning import autoencoders, calibration, dataset, stages, windows
from vertiwm_jax.learning.dataset import Collection, Drives, Split, SplitConfig
from vertiwm_jax.learning.fitting import FitConfig, Problem
from vertiwm_jax.learning.losses import LossConfig
from vertiwm_jax.learning.objectives import RolloutLoss, TeacherForcingLoss
from vertiwm_jax.learning.problem import WindowConfig, WindowData, WindowProblem
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.stages import Inputs
from vertiwm_jax.learning.windows import Windows
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import Vehicle, load_vehicle
from vertiwm_jax.models.config import ModelConfig, with_soil
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.runs import Run
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model.alone import Alone
from vertiwm_jax.world_model.verti_wm import VertiWMParams

Kind = Literal["rigid", "deformable", "mixed"]
KINDS: tuple[Kind, ...] = ("rigid", "deformable", "mixed")
"""Collections of drives, by the ground of their worlds; also the names of their folders."""
Specialist = Literal["transformer", "nesam"]
_PAIR: dict[Specialist, int] = {"transformer": 0, "nesam": -1}
"""Which pair of encoders a specialist sees by; they may be the same."""
SAMPLE = 512
"""Windows on which the constants of a model are measured before it learns."""


@dataclass(frozen=True)
class SpecialistConfig:
    """How one specialist is fitted."""

    learns_from: tuple[Kind, ...] = KINDS
    """Which collections it and its encoders are fitted to."""
    autoencoders: FitConfig = FitConfig(updates=1000, weight_decay=0.0)
    """The stage that fits autoencoders of terrain patches; their encoders are frozen afterwards."""
    single_steps: FitConfig = FitConfig(updates=400, warm_up=50)
    """The stage of single steps, each from a recorded state; it is cheap."""
    rollouts: FitConfig = FitConfig()
    """The stage of open-loop predictions, which is how the model is used."""

    def training(self, *names: str) -> Self:
        """The same, with these parameters trained in both stages of motion."""
        steps, rollouts = (replace(x, trainable=names) for x in (self.single_steps, self.rollouts))
        return replace(self, single_steps=steps, rollouts=rollouts)


@dataclass(frozen=True)
class GateConfig:
    """How the gate is fitted, to both specialists as they are."""

    learns_from: tuple[Kind, ...] = ("mixed",)
    """Which collections it is fitted to."""
    rollouts: FitConfig = FitConfig(updates=600, warm_up=50, trainable=("gate.network",))
    """The stage of open-loop predictions; `trainable` may also name parts of `transformer`, `nesam`
    and `encoders`."""


@settings
class PipelineConfig:
    """What world model is fitted, to what drives, and how."""

    data: tuple[Path, ...] = (Path("data/open"),)
    """Folders of drives, or of such folders named rigid, deformable and mixed. Drives in others are
    of no kind: all that is fitted learns from them."""
    add: tuple[Path, ...] = ()
    """Folders of more drives beside those, such as a policy has driven (`collect --policy`)."""
    reuse: tuple[Path, ...] = ()
    """Folders of earlier runs, whose stages are taken over where their inputs are the same."""
    splits: SplitConfig = dataset.FITTED
    """How drives are shared out whose files do not say what they are for, and which worlds are left
    out of the fit."""
    seed: CountOrZero = 0
    """Decides everything that is random."""
    model: ModelConfig = ModelConfig()
    """What is fitted."""
    vehicle: str | None = None
    """The vehicle whose physics NeSAM corrects: the name of a shipped one, or a YAML file.
    By default that of the model to go on from, or else the HMMWV; and of a model of any vehicle
    (`model.vehicles`) the one that each file of drives describes, where it does."""
    windows: WindowConfig = WindowConfig(weights=(1.0, 1.0, 2.0))
    """Which windows of the drives are learned from."""
    loss: LossConfig = LossConfig(velocity=0.05)
    """The loss of open-loop predictions."""
    patches: autoencoders.AutoencoderConfig = autoencoders.AutoencoderConfig()
    """Which patches of the ground autoencoders and soil predictor are fitted to."""
    transformer: SpecialistConfig = SpecialistConfig().training(
        "transformer.network", "encoders.0.reduce"
    )
    """How the specialist for rigid ground is fitted."""
    nesam: SpecialistConfig = SpecialistConfig().training("nesam.network")
    """How the specialist for soil is fitted."""
    soil: FitConfig = FitConfig(updates=2000, weight_decay=0.0, trainable=("soil",))
    """How the soil predictor is fitted."""
    gate: GateConfig = GateConfig()
    """How the gates that fuse both specialists are fitted."""

    def check(self):
        if self.vehicle:
            vehicle.load(self.vehicle)  # That it cannot be read is to be said now.
        kinds = self.transformer.learns_from, self.nesam.learns_from
        if self.model.encoders == "shared" and kinds[0] != kinds[1]:
            raise ValueError(
                f"model.encoders: expected own ones for specialists that learn from different "
                f"collections, {kinds[0]} and {kinds[1]}, found shared"
            )
        learned = self.gate.rollouts.trainable or ("all",)
        if self.model.gates > 1 and any(name.split(".")[0] != "gate" for name in learned):
            raise ValueError(
                f"gate.rollouts.trainable: expected nothing but gates where there are "
                f"{self.model.gates}, found {', '.join(learned)}"
            )


def expect_drives(config: PipelineConfig) -> list[Collection]:
    """The collections that all is fitted to.

    Raises `DataError` unless each has drives to train and to validate on, and one is long enough,
    and where a world that is to be left out is not there.
    """
    for name in config.model.parts:
        folders(config, getattr(config, name).learns_from)
    found = [Collection.of(folder, config.splits) for folder in folders(config, KINDS)]
    splits: tuple[Split, ...] = ("train", "validation")
    for split in splits:
        dataset.expect_drives(found, split, config.windows.context + config.windows.horizon)
    there = {name for collection in found for name in collection.left_out.values()}
    for name in config.splits.leave_out:
        if name not in there and name not in dataset.UNSEEN:
            places = ", ".join(str(collection.folder) for collection in found)
            raise DataError(
                f"splits.leave_out: expected ends of paths of files of drives, without .npz, such "
                f"as {dataset.UNSEEN[0]}, found {name}, which is not in {places}"
            )
    return found


def folders(config: PipelineConfig, kinds: Sequence[Kind]) -> list[Path]:
    """Those with drives of these kinds, and those of no kind."""
    chosen, given = list[Path](), config.data + config.add
    for folder in given:
        named = folder.absolute().name
        fits = named in kinds or named not in KINDS
        chosen += [folder] if fits and any(folder.glob("*.npz")) else []
        chosen += [folder / kind for kind in kinds if (folder / kind).is_dir()]
    if not chosen:
        raise DataError(
            f"{', '.join(map(str, given))}: expected files of drives on "
            f"{' or '.join(kinds)} ground, or folders of them named so, found neither"
        )
    return chosen


def fit(config: PipelineConfig, run: Run, start: VertiWMParams | None = None) -> VertiWMParams:
    """Runs all stages of the configured parts.

    Args:
        config: what is fitted, and how.
        run: in whose folder the stages are.
        start: parameters to go on from, by open-loop predictions alone.

    Returns:
        The parameters; those of parts that are not configured are untrained.

    Raises:
        DataError, MapError, ConfigError: of `load_drives`, `WindowData.of` and `fitting.fit`.
    """
    driven = vehicle.load(config.vehicle) if config.vehicle else None
    begun = () if driven is None else (str(driven),)
    if start is not None:
        start = start if driven is None else replace(start, vehicle=jax.device_put(driven.vehicle))
        begun = (stages.digest(start),)
    moved = driven.vehicle if driven else load_vehicle() if start is None else start.vehicle
    pipeline, key = _Pipeline(config, run, begun, start is None, moved), jax.random.key(config.seed)
    if start is None:
        constants = calibration.normalization(pipeline.load(KINDS, "train")[0])
        physics = chrono_like(moved)
        params = config.model.init_params(key, physics, constants)
    else:
        params = config.model.with_gates(start, key)
    ended: tuple[str, ...] = ()
    for name in ("nesam", "transformer"):
        if name in config.model.parts:
            params = pipeline.specialist(name, params)
            ended += pipeline.before
    return pipeline.gate(params, ended) if "gate" in config.model.parts else params


@dataclass
class _Pipeline:
    """What the stages of a fit share.

    begun: what is known of the parameters that it begins with. driven: the vehicle of all drives,
    or where files describe none. before: what the next stage builds on, by the digests of earlier
    ones. loaded: drives that were read.
    """

    config: PipelineConfig
    run: Run
    begun: tuple[str, ...]
    from_nothing: bool
    driven: Vehicle
    before: tuple[str, ...] = ()
    loaded: dict[Any, tuple[Drives, TerrainMap]] = field(default_factory=dict)

    def specialist(self, name: Specialist, params: VertiWMParams) -> VertiWMParams:
        """The parameters with one specialist fitted.

        First its encoders, then for NeSAM what soils look like, then how it moves.
        """
        model, config = self.config.model, getattr(self.config, name)
        kinds, sees = config.learns_from, name == "nesam" or model.terrain == "patches"
        self.before = ()
        if self.from_nothing and sees:
            params = self._encoders(name, params)
        self.before += self.begun
        if self.from_nothing and name == "nesam":
            sample = self._sample(kinds)
            measured = calibration.nesam_constants(model.nesam, self._on_its_soil(params), *sample)
            params = replace(params, nesam=measured.nesam)

        # What is learned of `Encoders.reduce` is learned from latents.
        alone = Alone(getattr(model, name), latents=sees and name == "transformer")
        own = getattr(params, name)
        deviation = tuple(own.normalization.transition_deviation.tolist())
        parts = [
            ("single_steps", TeacherForcingLoss(alone, deviation), config.single_steps),
            ("rollouts", RolloutLoss(alone, self.config.loss), config.rollouts),
        ]
        # A stage holds what is its specialist's alone, so that other runs may take it over.
        pair = self._on_its_soil(params).encoders[_PAIR[name]]
        pair = replace(pair, soil=None) if name == "transformer" else pair
        fitted = replace(VertiWMParams((pair,), params.vehicle), **{name: own})
        data = self._data(self._windows, self.config.windows, kinds)
        for part, objective, schedule in parts if self.from_nothing else parts[1:]:
            if not sees:
                trainable = [each for each in schedule.trainable if not each.startswith("encoders")]
                schedule = replace(schedule, trainable=tuple(trainable))
            problem = WindowProblem(alone, objective, self.config.windows)
            fitted = self._fit(f"{name}_{part}", problem, schedule, kinds, fitted, data)
        (learned,) = fitted.encoders
        learned = replace(learned, soil=learned.soil or params.encoders[_PAIR[name]].soil)
        params = replace(params, **{name: getattr(fitted, name)})
        return _with_pair(params, name, learned)

    def _encoders(self, name: Specialist, params: VertiWMParams) -> VertiWMParams:
        """The parameters with the encoders of a specialist, and NeSAM's soil predictor, fitted."""
        kinds, patches = getattr(self.config, name).learns_from, self.config.patches
        places = self._data(autoencoders.PatchData.of, patches, kinds)
        seeing = "transformer" if self.config.model.encoders == "shared" else name
        schedule = getattr(self.config, seeing).autoencoders
        problem = autoencoders.AutoencoderProblem(patches)
        stage = f"{seeing}_autoencoders", problem, schedule, kinds
        pair = self._fit(*stage, problem.init_params(self._key(seeing)), places)
        found = replace(params.encoders[_PAIR[name]], **autoencoders.encoders(pair))
        if name == "nesam":
            looks = {"semantic": found.semantic, "soil": found.soil}
            stage = f"{name}_soil", autoencoders.SoilProblem(patches), self.config.soil, kinds
            found = replace(found, soil=self._fit(*stage, looks, places)["soil"])
        return _with_pair(params, name, found)

    def gate(self, params: VertiWMParams, before: tuple[str, ...]) -> VertiWMParams:
        """The parameters with the gates fitted; before: the digests of both specialists."""
        config, soil = self.config.gate, params.encoders[-1].soil
        learned = config.rollouts.trainable
        latents = not learned or any(name.startswith("encoders") for name in learned)
        verti_wm = replace(self.config.model.verti_wm, latents=latents)
        params = self._on_its_soil(params)
        if self.from_nothing:
            sample = self._sample(config.learns_from)
            params = calibration.gate_constants(verti_wm, params, *sample)
        objective = RolloutLoss(verti_wm, self.config.loss, attrgetter("coefficients"))
        problem = WindowProblem(verti_wm, objective, self.config.windows)
        data = self._data(self._windows, self.config.windows, config.learns_from)
        schedule = problem, config.rollouts, config.learns_from
        fitted: list[VertiWMParams] = []
        assert params.gate is not None
        for number in range(len(params.gate)):
            alone = replace(params, gate=params.gate.only(number))
            name, self.before = f"gate_{number}" if number else "gate", before
            fitted.append(self._fit(name, *schedule, alone, data))
        gates = [each.gate for each in fitted if each.gate is not None]
        return with_soil(replace(fitted[0], gate=gates[0].beside(*gates[1:])), soil)

    def _on_its_soil(self, params: VertiWMParams) -> VertiWMParams:
        """The parameters without a soil predictor, if the model takes the soils of the map."""
        return with_soil(params, None) if self.config.model.soil == "map" else params

    def _fit(
        self,
        name: str,
        problem: Problem,
        config: FitConfig,
        kinds: Sequence[Kind],
        params: Params,
        data: Callable[[], Any],
    ) -> Any:
        """The fitted parameters of a stage, on which the next one builds."""
        found = [
            Collection.of(folder, self.config.splits) for folder in folders(self.config, KINDS)
        ]
        drives = tuple(
            (file.name, file.stat().st_size, zlib.crc32(" ".join(purposes).encode()))
            for collection in found
            for file, purposes in collection.purposes.items()
        )
        key = self._key(name)
        seed = tuple(jax.random.key_data(key).tolist())
        inputs = Inputs(problem, config, seed, tuple(kinds), drives, self.before)
        self.before = (inputs.digest,)
        return stages.fit(self.run, name, inputs, params, data, key, self.config.reuse)

    def _key(self, name: str) -> jax.Array:
        return jax.random.fold_in(jax.random.key(self.config.seed), zlib.crc32(name.encode()))

    def _data(self, of: Any, config: Any, kinds: Sequence[Kind]) -> Callable[[], Any]:
        """What is made once of drives to learn from and to validate on, if it is asked for."""
        return cache(lambda: of(config, self.load(kinds, "train"), self.load(kinds, "validation")))

    def _windows(self, config: WindowConfig, *drives: tuple[Drives, TerrainMap]) -> WindowData:
        """Windows to learn from and to validate on, with the vehicles that drove there."""
        return WindowData.of(config, *drives, otherwise=self._otherwise)

    @property
    def _otherwise(self) -> Vehicle | None:
        """The vehicle where files describe none; None where all drives are of one."""
        of_any = self.config.model.vehicles == "any" and not self.config.vehicle
        return self.driven if of_any else None

    def load(self, kinds: Sequence[Kind], split: Split) -> tuple[Drives, TerrainMap]:
        """Drives of these kinds in all folders, and those of no kind."""
        key = tuple(kinds), split
        if key not in self.loaded:
            drives, terrain = dataset.load_drives(
                folders(self.config, kinds), split, self.config.splits, wheels=False
            )
            drives.expect_steered_by(self.driven)
            self.loaded[key] = drives, terrain
        return self.loaded[key]

    def _sample(self, kinds: Sequence[Kind]) -> tuple[TerrainMap, Windows, Vehicle | None]:
        """Some windows of the training drives, as a measurement takes them, their ground, and the
        vehicles that files describe."""
        recorded, terrain = self.load(kinds, "train")
        config = self.config.windows
        index = windows.index(recorded, terrain, config.context, config.horizon, config.stride)
        rows = np.linspace(0, len(index.drive) - 1, SAMPLE).astype(int)
        vehicles = self._otherwise and recorded.driven(self._otherwise)
        return terrain, windows.gather(recorded, index, rows), vehicles


def _with_pair(params: VertiWMParams, name: Specialist, pair: Encoders) -> VertiWMParams:
    """The parameters with other encoders of a specialist."""
    encoders = list(params.encoders)
    encoders[_PAIR[name]] = pair
    return replace(params, encoders=tuple(encoders))
