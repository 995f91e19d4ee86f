"""Fitted models on disk: a folder with the weights and what they are of."""

from dataclasses import fields, replace
from pathlib import Path

import jax

from vertiwm_jax import checkpoints
from vertiwm_jax import config as configuration
from vertiwm_jax.mechanics import vehicle as vehicles
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import Vehicle, load_vehicle
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.world_model.verti_wm import VertiWMParams

_SHIPPED = Path(__file__).parents[1] / "weights"
PRETRAINED, ANY_VEHICLE = _SHIPPED / "pretrained", _SHIPPED / "any_vehicle"
"""Folders of the models that come with the package, of the HMMWV and of any vehicle whose front
wheels steer; `docs/model_card.md` describes them."""
_CONFIG = "model.yaml"


def find(folder: str | Path) -> Path:
    """The folder of a model, which may be the name of one that comes with the package."""
    shipped = {path.name: path for path in (PRETRAINED, ANY_VEHICLE)}
    return shipped.get(str(folder), Path(folder))


def shipped(vehicle: Vehicle | None = None) -> Path:
    """The folder of the model that comes with the package for a vehicle, the HMMWV by default."""
    known = vehicle is None or vehicles.equal(vehicle, load_vehicle())
    return PRETRAINED if known else ANY_VEHICLE


def save(folder: Path, config: ModelConfig, params: VertiWMParams) -> None:
    """Write a model to `folder`, for `load`, in place of one there; as `checkpoints.save`."""
    before = checkpoints.latest(folder)
    checkpoints.save(folder, int(before.name) + 1 if before else 0, params, keep=1)
    configuration.save(config, folder / _CONFIG)


def load(folder: Path) -> tuple[ModelConfig, VertiWMParams]:
    """What `save` wrote to `folder`; parts that are not among the configured ones are untrained.

    `ConfigError` or `CheckpointError` when it holds none, or one of another version.
    """
    config = configuration.load(ModelConfig, folder / _CONFIG)
    path = checkpoints.latest(folder)
    if path is None:
        raise checkpoints.CheckpointError(f"{folder}: expected the weights of a model, found none")
    like = jax.eval_shape(
        lambda key: config.init_params(key, chrono_like(load_vehicle())), jax.random.key(0)
    )
    # Of wheels, a vehicle has one number or four, and some have no numbers of their layout.
    found = checkpoints.outline(path)
    names = {field.name: f"vehicle.{field.name}" for field in fields(Vehicle)}
    own = {field: found[name] for field, name in names.items() if name in found}
    like = replace(like, vehicle=replace(like.vehicle, **own))
    return config, checkpoints.load(path, like)
