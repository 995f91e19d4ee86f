"""Every model of this package by name, for commands that let their users choose."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax
from jax.tree_util import DictKey

from vertiwm_jax.checkpoints import CheckpointError
from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.mechanics.kinematic import KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import Vehicle, hmmwv
from vertiwm_jax.world_model import model
from vertiwm_jax.world_model.model import ModelConfig, VertiWM
from vertiwm_jax.world_model.nesam import Nesam, SoilSource
from vertiwm_jax.world_model.perception import Eyes, Sighted, SightedParams
from vertiwm_jax.world_model.transformer_specialist import TransformerSpecialist

D = TypeVar("D", bound=Dynamics)
P = TypeVar("P")

ModelName = Literal["builtin", "transformer", "nesam", "vertiwm"]
"""The simulator, which has learned nothing; either specialist; both of them fused."""
Imagined = Literal["bicycle", "builtin", "transformer", "nesam", "vertiwm"]
"""What a planner may imagine in: those, and a kinematic bicycle, which knows no forces."""
Operands = Literal["float32", "bfloat16"]
"""What the weights of specialists, and what they are multiplied by, are rounded to."""


def choose(
    name: Imagined,
    weights: Path | None = None,
    soil: SoilSource | None = None,
    vehicle: Vehicle | None = None,
) -> tuple[Dynamics, Params]:
    """The model and its parameters.

    weights: folder of a fitted model; the one that comes with the package by default. soil: where
    NeSAM has soils from, if not from where it had them when it was fitted. vehicle: of simulator
    and bicycle, the HMMWV by default; learned models move the one that they were fitted to. Raises
    what `model.load` raises, and `CheckpointError` when it holds other parts alone.
    """
    if name == "builtin":
        return Simulator(), chrono_like(vehicle or hmmwv())
    if name == "bicycle":
        return KinematicBicycle(), bicycle_of(vehicle or hmmwv())
    folder = weights or model.PRETRAINED
    found = fitted(folder, soil)
    if name not in found:
        raise CheckpointError(f"{folder}: expected {name}, found {' and '.join(found)} alone")
    return found[name]


def load_model(
    name: Imagined = "vertiwm",
    weights: str | Path | None = None,
    *,
    vehicle: Vehicle | None = None,
    soil: SoilSource | None = None,
    compute_dtype: Operands = "float32",
    embeddings: bool = False,
) -> tuple[Dynamics, Params]:
    """Loads a model of how a vehicle moves.

    Args:
        name: `vertiwm`; its specialists alone, `transformer` and `nesam`; `builtin`, the
            simulator; or `bicycle`, which knows no forces.
        weights: folder of a fitted model; the one that comes along by default.
        vehicle: what simulator and bicycle drive, the HMMWV by default; learned models move the
            one that they were fitted to.
        soil: where NeSAM has soils from, `map` or `predicted`; by default as it was fitted.
        compute_dtype: what learned models multiply.
        embeddings: whether the history holds the ground as encoders see it.

    Returns:
        The model, and its parameters.

    Raises:
        CheckpointError: there is no such model in the folder, or it cannot be read.
    """
    folder = Path(weights) if weights else None
    model, params = choose(name, folder, soil, vehicle)
    params = rounded(params, compute_dtype)
    return sighted(name, model, params, folder) if embeddings else (model, params)


def sighted(
    name: Imagined, dynamics: Dynamics, params: Params, weights: Path | None = None
) -> tuple[Dynamics, Params]:
    """A model of `choose` that sees by the Transformer's encoders, whatever it sees by itself.

    So a policy learns and drives by the same eyes everywhere. What the model has computed already
    is not computed again. Raises like `choose`, with "transformer".
    """
    config, seen_by = _eyes(weights)
    seeing = {"vertiwm", "transformer"} | ({"nesam"} if config.encoders == "shared" else set())
    if name in seeing:
        if isinstance(dynamics, VertiWM):  # What policies see is the Transformer's.
            dynamics = replace(dynamics, nesam=lean(dynamics.nesam))
        return dynamics, params
    return Sighted(dynamics), SightedParams(params, seen_by)


def eyes(weights: Path | None = None) -> Eyes:
    """The Transformer's encoders, by which policies see; raises like `sighted`."""
    return _eyes(weights)[1]


def exact(dynamics: Dynamics) -> Dynamics:
    """The same model, whose gradient goes through its physics as it is.

    Fitting needs only how physics answers on the whole (`Nesam.gradient`); by that, commands would
    move nothing. Values are the same.
    """
    if isinstance(dynamics, Nesam):
        return replace(dynamics, gradient="exact")
    if isinstance(dynamics, VertiWM) and isinstance(dynamics.nesam, Nesam):
        return replace(dynamics, nesam=replace(dynamics.nesam, gradient="exact"))
    if isinstance(dynamics, Sighted):
        return replace(dynamics, dynamics=exact(dynamics.dynamics))
    return dynamics


def lean(dynamics: D) -> D:
    """The same model, which remembers no latents where nothing needs them, to drive and to plan.

    A step takes a CPU less time. Values are the same, to rounding; `dynamics.embedding` has none.
    """
    if isinstance(dynamics, TransformerSpecialist) and dynamics.terrain == "patches":
        return replace(dynamics, remembers="glance")
    if isinstance(dynamics, Nesam) and dynamics.soil == "map":
        return replace(dynamics, remembers="glance")
    if isinstance(dynamics, VertiWM):
        transformer = dynamics.transformer if dynamics.looks_at_both else lean(dynamics.transformer)
        return replace(dynamics, transformer=transformer, nesam=lean(dynamics.nesam))
    return dynamics


def rounded(params: P, operands: Operands) -> P:
    """Parameters whose specialists multiply the weights of their Transformers as `operands`.

    Encoders, gates, physics, poses and all sums stay float32. In bfloat16 a step is faster where
    the processor multiplies it (AVX512_BF16), and slower elsewhere (docs/performance.md).
    """

    def one(path: Sequence[Any], leaf: jax.Array) -> jax.Array:
        names = [key.key for key in path if isinstance(key, DictKey)]
        large = names[-1:] == ["kernel"] and {"transformer", "embed_ground"} & set(names)
        return leaf.astype(operands) if large else leaf

    return jax.tree.map_with_path(one, params)


def fitted(
    folder: Path, soil: SoilSource | None = None
) -> dict[ModelName, tuple[Dynamics, Params]]:
    """The models that are fitted in a folder, and their parameters; `soil` as in `choose`.

    Raises like `model.load`.
    """
    config, params = model.load(folder)
    config = replace(config, soil=soil or config.soil)
    models: dict[ModelName, tuple[Dynamics, Params]] = {}
    if "gate" in config.parts:
        models["vertiwm"] = (config.build(), params)
    if "nesam" in config.parts:
        models["nesam"] = (config.nesam, params.nesam)
    if "transformer" in config.parts:
        models["transformer"] = (config.transformer, params.transformer)
    return models


def _eyes(weights: Path | None) -> tuple[ModelConfig, Eyes]:
    folder = weights or model.PRETRAINED
    config, found = model.load(folder)
    if "transformer" not in config.parts or config.terrain != "patches":
        raise CheckpointError(
            f"{folder}: expected the encoders of a Transformer, for navigation.embeddings, "
            f"found {' and '.join(config.parts)} with terrain {config.terrain!r}"
        )
    return config, Eyes(config.transformer.exteroception, found.transformer.encoders)
