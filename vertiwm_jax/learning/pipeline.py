"""The whole of Verti-WM from recorded drives: what is fitted, in which order, to which drives.

Every stage is a `stages.fit` in a folder of its own inside that of the run.
"""

import operator
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from vertiwm_jax.config import settings
from vertiwm_jax.dynamics import Params
from vertiwm_jax.learning import autoencoders, dataset, normalisation, stages, windows
from vertiwm_jax.learning.autoencoders import AutoencoderConfig, AutoencoderProblem, PatchData
from vertiwm_jax.learning.dataset import Auxiliary, Drives, Split
from vertiwm_jax.learning.fitting import FitConfig, Problem
from vertiwm_jax.learning.losses import LossConfig
from vertiwm_jax.learning.rollouts import OneStep, OpenLoop, WindowConfig, WindowData, WindowProblem
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.learning.soils import SoilProblem
from vertiwm_jax.learning.stages import Inputs
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import VehicleConfig, hmmwv
from vertiwm_jax.runs import Run
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.world_model import model, nesam
from vertiwm_jax.world_model.model import ModelConfig, VertiWM, VertiWMParams
from vertiwm_jax.world_model.nesam import Nesam
from vertiwm_jax.world_model.transformer_specialist import TransformerSpecialist

Kind = Literal["rigid", "deformable", "mixed"]
KINDS: tuple[Kind, ...] = ("rigid", "deformable", "mixed")
"""Collections of drives, by the ground of their worlds; also the names of their folders."""
SAMPLE = 512
"""Windows on which the constants of a model are measured before it learns."""


@dataclass(frozen=True)
class SpecialistConfig:
    """How one specialist is fitted."""

    learns_from: tuple[Kind, ...] = KINDS
    """Collections for it and for its encoders."""
    autoencoders: FitConfig = FitConfig(updates=1000, weight_decay=0.0)
    """Of terrain patches; the encoders are frozen afterwards."""
    single_steps: FitConfig = FitConfig(updates=400, warm_up=50, trainable=("network",))
    """From recorded states, all of a window at once: a cheap beginning."""
    rollouts: FitConfig = FitConfig(updates=10_000, trainable=("network",))
    """Open loop, as it will be used."""


@dataclass(frozen=True)
class GateConfig:
    """How the gate is fitted, to both specialists as they are."""

    learns_from: tuple[Kind, ...] = ("mixed",)
    """Collections for it."""
    rollouts: FitConfig = FitConfig(updates=600, warm_up=50, trainable=("gate.network",))
    """Open loop; `trainable` may name parts of `transformer` and `nesam` too."""


@settings
class PipelineConfig:
    """What world model is fitted, and how."""

    model: ModelConfig = ModelConfig()
    """What is fitted."""
    vehicle: str | None = None
    """Whose physics NeSAM corrects: the name of a vehicle that comes along, or a YAML file of one;
    by default that of the model to go on from, or else the HMMWV."""
    windows: WindowConfig = WindowConfig(weights=(1.0, 1.0, 2.0))
    """Which windows of the drives."""
    loss: LossConfig = LossConfig(velocity=0.05)
    """Of predictions."""
    patches: AutoencoderConfig = AutoencoderConfig()
    """Which patches of the ground, for autoencoders and soil predictor."""
    transformer: SpecialistConfig = SpecialistConfig()
    """The specialist for rigid ground."""
    nesam: SpecialistConfig = SpecialistConfig()
    """The specialist for soil."""
    soil: FitConfig = FitConfig(updates=2000, weight_decay=0.0, trainable=("soil",))
    """The soil predictor."""
    gate: GateConfig = GateConfig()
    """What fuses the two."""

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

    @property
    def driven(self) -> VehicleConfig | None:
        """The vehicle, if one is chosen; `ConfigError` if there is no such."""
        return vehicle.load(self.vehicle) if self.vehicle else None


def fit(
    config: PipelineConfig,
    folders: Sequence[Path],
    key: jax.Array,
    run: Run,
    reuse: Sequence[Path] = (),
    start: VertiWMParams | None = None,
) -> VertiWMParams:
    """All stages of the configured parts; gives their parameters, and others untrained.

    folders: of drives, or of folders of drives named like `KINDS`; reuse: of other runs, whose
    stages are taken over where their inputs are the same; start: parameters to go on from, by
    open-loop predictions alone. Raises what `dataset.load`, `WindowData.of` and `fitting.fit`
    raise.
    """
    driven = config.driven
    if start is not None and driven is not None:
        simulator = replace(start.nesam.simulator, vehicle=jax.device_put(driven.vehicle))
        start = replace(start, nesam=replace(start.nesam, simulator=simulator))
    pipeline = _Pipeline(config, tuple(folders), key, run, tuple(reuse), start)
    digests: list[str] = []
    built, parts = config.model, config.model.parts
    if start is None:
        constants = normalisation.measure(pipeline.load(KINDS, "train")[0])
        physics = chrono_like(driven.vehicle if driven else hmmwv())
        params = built.init_params(key, physics, constants)
    else:
        params = built.with_gates(start, key)
    if "nesam" in parts:
        second, digest = pipeline.specialist("nesam", built.nesam, params.nesam, config.nesam)
        params = replace(params, nesam=second)
        digests.append(digest)
    if "transformer" in parts:
        settings = config.transformer
        specialist, untrained = built.transformer, params.transformer
        first, digest = pipeline.specialist("transformer", specialist, untrained, settings)
        params = replace(params, transformer=first)
        digests.append(digest)
    return pipeline.gate(built.build(), params, digests) if "gate" in parts else params


@dataclass(frozen=True)
class _Pipeline:
    """What its stages share."""

    config: PipelineConfig
    folders: tuple[Path, ...]
    key: jax.Array
    run: Run
    reuse: tuple[Path, ...]
    start: VertiWMParams | None

    def specialist(
        self,
        name: str,
        specialist: TransformerSpecialist | Nesam,
        params: Any,
        config: SpecialistConfig,
    ) -> tuple[Any, str]:
        """Its encoders, then for NeSAM what soils look like, then how it moves; and the digest."""
        kinds, before = config.learns_from, self._begun
        drives = self._drives(kinds)
        if self.start is None and params.encoders is not None:
            patches = self.config.patches
            places = cache(lambda: PatchData.of(patches, *drives()))
            seeing, schedule = name, config.autoencoders
            if self.config.model.encoders == "shared":
                seeing, schedule = "transformer", self.config.transformer.autoencoders
            problem = AutoencoderProblem(patches)
            pair = problem.init_params(self._key(seeing))
            stage = f"{seeing}_autoencoders", problem, schedule, kinds
            pair, digest = self._fit(*stage, pair, places)
            before = (digest,)
            params = replace(params, encoders=autoencoders.encoders(pair))
            if isinstance(specialist, Nesam):
                looks = {"encoders": params.encoders, "soil": params.soil}
                problem = SoilProblem(patches)
                stage = f"{name}_soil", problem, self.config.soil, kinds
                looks, digest = self._fit(*stage, looks, places, before)
                before = (*before, digest)
                params = replace(params, soil=looks["soil"])
        if self.start is None and isinstance(specialist, Nesam):
            params = nesam.calibrate(specialist, params, *self._sample(drives))

        data = cache(lambda: WindowData.of(self.config.windows, *drives()))
        deviation = tuple(params.normalisation.transition_deviation.tolist())
        single, rollouts = OneStep(specialist, deviation), OpenLoop(specialist, self.config.loss)
        parts = [
            ("single_steps", single, config.single_steps),
            ("rollouts", rollouts, config.rollouts),
        ]
        for part, objective, schedule in parts if self.start is None else parts[1:]:
            problem = WindowProblem(specialist, objective, self.config.windows)
            stage = f"{name}_{part}", problem, schedule, kinds
            params, digest = self._fit(*stage, params, data, before)
            before = (digest,)
        return params, digest

    def gate(
        self, verti_wm: VertiWM, params: VertiWMParams, before: Sequence[str]
    ) -> VertiWMParams:
        """The gates between two specialists, whose digests are given."""
        config = self.config.gate
        drives = self._drives(config.learns_from)
        if self.start is None:
            params = model.calibrate(verti_wm, params, *self._sample(drives))
        objective = OpenLoop(verti_wm, self.config.loss, operator.attrgetter("coefficients"))
        problem = WindowProblem(verti_wm, objective, self.config.windows)
        data = cache(lambda: WindowData.of(self.config.windows, *drives()))
        schedule = problem, config.rollouts, config.learns_from
        fitted: list[VertiWMParams] = []
        for number in range(len(params.gate)):
            alone = replace(params, gate=params.gate.only(number))
            name = f"gate_{number}" if number else "gate"
            fitted.append(self._fit(name, *schedule, alone, data, before)[0])
        first, *others = fitted
        return replace(first, gate=first.gate.beside(*(each.gate for each in others)))

    def _fit(
        self,
        name: str,
        problem: Problem,
        config: FitConfig,
        kinds: Sequence[Kind],
        params: Params,
        data: Callable[[], Any],
        before: Sequence[str] = (),
    ) -> tuple[Any, str]:
        """The fitted parameters of a stage, and what later ones know its inputs by."""
        files = [file for folder in self._folders(KINDS) for file in sorted(folder.glob("*.npz"))]
        drives = tuple((file.name, file.stat().st_size) for file in files)
        key = self._key(name)
        seed = tuple(jax.random.key_data(key).tolist())
        inputs = Inputs(problem, config, seed, tuple(kinds), drives, tuple(before))
        fitted = stages.fit(self.run, name, inputs, params, data, key, self.reuse)
        return fitted, inputs.digest

    @property
    def _begun(self) -> tuple[str, ...]:
        """What the first stages know the parameters by that they go on from."""
        if self.start is not None:
            return (stages.digest(self.start),)
        driven = self.config.driven
        return () if driven is None else (str(driven),)

    def _key(self, name: str) -> jax.Array:
        return jax.random.fold_in(self.key, zlib.crc32(name.encode()))

    def _drives(
        self, kinds: Sequence[Kind]
    ) -> Callable[[], tuple[tuple[Drives, TerrainMap], tuple[Drives, TerrainMap]]]:
        """Reads drives to learn from and to validate on, once."""
        return cache(lambda: (self.load(kinds, "train"), self.load(kinds, "validation")))

    def load(self, kinds: Sequence[Kind], split: Split) -> tuple[Drives, TerrainMap]:
        """Drives of these kinds in all folders, and of folders that are not divided into kinds."""
        drives, terrain = dataset.load(self._folders(kinds), split)
        return replace(drives, auxiliary=Auxiliary()), terrain

    def _folders(self, kinds: Sequence[Kind]) -> list[Path]:
        chosen: list[Path] = []
        for folder in self.folders:
            chosen += [folder] if any(folder.glob("*.npz")) else []
            chosen += [folder / kind for kind in kinds if (folder / kind).is_dir()]
        if not chosen:
            raise DataError(
                f"{', '.join(map(str, self.folders))}: expected files of drives, or folders of "
                f"them named {' or '.join(kinds)}, found neither"
            )
        return chosen

    def _sample(self, drives: Callable) -> tuple[TerrainMap, VehicleState, Command]:
        """Some windows of the training drives as a measurement takes them, each on its world."""
        recorded, terrain = drives()[0]
        config = self.config.windows
        index = windows.index(recorded, terrain, config.context, config.horizon, config.stride)
        rows = np.linspace(0, len(index.drive) - 1, SAMPLE).astype(int)
        some = windows.gather(recorded, jax.tree.map(lambda x: x[rows], index))
        states = VehicleState.from_vector(some.state)
        return terrain.select(some.world), states, Command.from_vector(some.control)
