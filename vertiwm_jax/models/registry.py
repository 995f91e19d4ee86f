"""Every model of this package by name."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp

from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.mechanics.kinematic import (
    DifferentialDrive,
    KinematicBicycle,
    bicycle_of,
    differential_of,
)
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import Vehicle, load_vehicle
from vertiwm_jax.models import files
from vertiwm_jax.models.config import SoilSource, with_soil
from vertiwm_jax.networks.specialist import ComputeDtype, cast_weights
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.precision import float32
from vertiwm_jax.world_model.alone import Alone
from vertiwm_jax.world_model.verti_wm import VertiWMParams

ModelName = Literal["builtin", "transformer", "nesam", "vertiwm"]
"""The simulator, which has learned nothing; either specialist; both of them fused."""
Imagined = Literal["bicycle", "builtin", "transformer", "nesam", "vertiwm"]
"""What a planner may imagine in: those, and a kinematic bicycle, which knows no forces."""


@float32
def load_model(
    name: Imagined = "vertiwm",
    weights: str | Path | None = None,
    *,
    vehicle: Vehicle | None = None,
    soil: SoilSource | None = None,
    embeddings: bool = False,
    compute_dtype: ComputeDtype = "float32",
    exact_gradient: bool = False,
    ruts: bool = False,
) -> tuple[Dynamics, Params]:
    """A model and its parameters.

    Args:
        name: which one.
        weights: folder of a fitted model, or the name of one that comes with the package:
            `pretrained`, the HMMWV's, or `any_vehicle`. By default the first for the HMMWV, and the
            second for every other vehicle.
        vehicle: which one it moves. By default simulator and bicycle move the HMMWV, and learned
            models the vehicle that they were fitted to; those of one vehicle move no other.
        soil: where NeSAM has soils from, if not from where it had them when it was fitted.
        embeddings: whether histories keep the latents that the Transformer sees, for a policy to
            see them (`dynamics.embedding`). Models without a Transformer keep none.
        compute_dtype: what learned models multiply large matrices in; see `cast_weights`.
        exact_gradient: whether gradients go through the physics of NeSAM as it is, as planning by
            gradients and adapting soils need it. Fitting needs only how physics answers on the
            whole (`Nesam.gradient`), which is several times cheaper.
        ruts: whether soil remembers how deep wheels have pressed it; of the simulator, NeSAM and
            what is fused of it. The others know no wheels.

    Raises:
        CheckpointError, ConfigError: as `files.load`, and when the folder holds other parts alone,
            or a model of vehicles that are steered otherwise.
    """
    if name == "builtin":
        return Simulator(ruts=ruts), chrono_like(vehicle or load_vehicle())
    if name == "bicycle":
        driven = vehicle or load_vehicle()
        if driven.skid is not None:
            return DifferentialDrive(), differential_of(driven)
        return KinematicBicycle(), bicycle_of(driven)
    folder = files.find(weights) if weights else files.shipped(vehicle)
    found = load_fitted(folder, soil, embeddings, exact_gradient, ruts)
    if name not in found:
        raise CheckpointError(f"{folder}: expected {name}, found {' and '.join(found)} alone")
    dynamics, params = found[name]
    if vehicle is not None and moves_any(dynamics):
        if vehicle.turn != params.vehicle.turn:
            kinds = {"steering": "whose front wheels steer", "yaw_rate": "that is skid-steered"}
            raise CheckpointError(
                f"{folder}: expected a vehicle {kinds[params.vehicle.turn]}, found one "
                f"{kinds[vehicle.turn]}; fit a model to its drives"
            )
        params = moving(params, vehicle)
    return dynamics, cast_weights(params, compute_dtype)


def moves_any(dynamics: Dynamics) -> bool:
    """Whether a learned model is of any vehicle, which `moving` gives it."""
    part = getattr(dynamics, "nesam", None) or getattr(dynamics, "specialist", None)
    return getattr(part, "any_vehicle", False)


def moving(params: VertiWMParams, vehicle: Vehicle) -> VertiWMParams:
    """The parameters of a learned model of another vehicle."""
    return replace(params, vehicle=jax.tree.map(jnp.asarray, vehicle))


def load_fitted(
    folder: Path,
    soil: SoilSource | None = None,
    embeddings: bool = False,
    exact_gradient: bool = False,
    ruts: bool = False,
) -> dict[ModelName, tuple[Dynamics, VertiWMParams]]:
    """The models that are fitted in a folder, and their parameters; as `load_model`."""
    config, params = files.load(folder)
    if (soil or config.soil) == "map":
        params = with_soil(params, None)
    gradient: Literal["exact", "mean"] = "exact" if exact_gradient else "mean"
    simulator = replace(config.nesam.simulator, ruts=ruts)
    nesam = replace(config.nesam, gradient=gradient, simulator=simulator)
    models: dict[ModelName, tuple[Dynamics, VertiWMParams]] = {}
    if "gate" in config.parts:
        fused = replace(config.verti_wm, nesam=nesam, latents=embeddings)
        models["vertiwm"] = fused, params
    if "nesam" in config.parts:
        alone = Alone(nesam)
        models["nesam"] = alone, alone.part_of(params)
    if "transformer" in config.parts:
        alone = Alone(config.transformer, embeddings and config.terrain == "patches")
        models["transformer"] = alone, alone.part_of(params)
    return models


def load_encoders(weights: str | Path | None = None) -> Encoders:
    """The Transformer's encoders, by which policies see the ground in whatever they drive.

    Both models that come with the package have the same.

    Raises like `load_model`, with "transformer".
    """
    folder = files.find(weights or files.PRETRAINED)
    config, params = files.load(folder)
    if "transformer" not in config.parts or config.terrain != "patches":
        raise CheckpointError(
            f"{folder}: expected the encoders of a Transformer, for navigation.embeddings, "
            f"found {' and '.join(config.parts)} with terrain {config.terrain!r}"
        )
    return replace(params.encoders[0], reduce=None, soil=None)
