"""Fitted models on disk: a folder with the weights and what they are of."""

from pathlib import Path

import jax

from vertiwm_jax import checkpoints
from vertiwm_jax import config as configuration
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.world_model.verti_wm import VertiWMParams

PRETRAINED = Path(__file__).parents[1] / "weights"
"""Folder of the model that comes with the package; its model card is `docs/model_card.md`."""
_CONFIG = "model.yaml"


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
    leaves = jax.tree.leaves_with_path(like)
    names = [jax.tree_util.keystr(at, simple=True, separator=".") for at, _ in leaves]
    if "vehicle.mass" in checkpoints.names(path):
        return config, checkpoints.load(path, like)
    before = {name: _before(name, config) for name in names}
    stored = {before[name]: leaf for name, (_, leaf) in zip(names, leaves, strict=True)}
    if config.encoders == "shared":  # NeSAM's own were stored, too, and never used.
        pair = "transformer.encoders."
        unused = {name: leaf for name, leaf in stored.items() if name.startswith(pair)}
        stored |= {name.replace("transformer", "nesam"): leaf for name, leaf in unused.items()}
    found = checkpoints.load(path, stored)
    weights = [found[before[name]] for name in names]
    return config, jax.tree.unflatten(jax.tree.structure(like), weights)


def _before(name: str, config: ModelConfig) -> str:
    """What a leaf of the parameters was called in version 0.1."""
    first = "transformer" if config.terrain == "patches" else "nesam"
    renamed = {
        "encoders.0.soil.": "nesam.soil.",
        "encoders.1.soil.": "nesam.soil.",
        "encoders.0.reduce.": "transformer.network.params.reduce.",
        "encoders.0.": f"{first}.encoders.",
        "encoders.1.": "nesam.encoders.",
        "vehicle.": "nesam.simulator.vehicle.",
        "nesam.contact.": "nesam.simulator.contact.",
        "nesam.stiffening": "nesam.simulator.stiffening",
        "transformer.normalization.": "transformer.normalisation.",
        "nesam.normalization.": "nesam.normalisation.",
    }
    for now, before in renamed.items():
        if name.startswith(now):
            return before + name.removeprefix(now)
    return name
