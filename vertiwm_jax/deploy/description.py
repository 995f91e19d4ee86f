"""A learned policy in plain numbers: what `policy.json` says of it, and its weights."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vertiwm_jax
from vertiwm_jax.env import observation
from vertiwm_jax.env.controllers import REFERENCE, LookAhead, StraightToGoal
from vertiwm_jax.env.observation import ARC_STATIONS, ARC_STEERING, ObservationSpec, Part
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.traversability import TraversabilityCost
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.networks.policy import TanhNormalActor
from vertiwm_jax.rl import running_statistics
from vertiwm_jax.rl.learned import DeterministicPolicy, ResidualPolicy
from vertiwm_jax.state import STEP_SECONDS, Command
from vertiwm_jax.terrain.classes import STANDARD

_SIZES = "length", "width", "wheelbase", "track", "ride_height", "steering_limit"
_BASES = {LookAhead: "look ahead", StraightToGoal: REFERENCE}


def about(
    policy: ResidualPolicy | DeterministicPolicy,
    config: NavigationConfig,
    vehicle: Vehicle,
    held: int,
) -> dict[str, Any]:
    """What the numbers of a policy mean, for JSON.

    config: of the environment; vehicle: what drives; held: steps for which its
    actions were held while it learned.
    """
    places, heading = observation.poses_ahead(vehicle)
    still = Command(jnp.float32(0), jnp.float32(0))
    base = policy.base if isinstance(policy, ResidualPolicy) else None
    image = _learned(policy).actor.layout.image
    seen = ObservationSpec(image=image is not None)
    return {
        "vertiwm_jax": vertiwm_jax.__version__,
        "step_seconds": STEP_SECONDS,
        "held_while_learning": held,
        "observation": {
            "size": seen.size,
            "limit": observation.OBSERVATION_LIMIT,
            "parts": {name: _part(part) for name, part in seen.parts.items()},
            "places": np.column_stack([places, heading]).tolist(),
            "class_places": observation.CLASS_PLACES.tolist(),
        },
        "action": {
            "speed_range": config.speed_range,
            "steering_limit": float(vehicle.steering_limit),
            "standing": vehicle.action(still, config.speed_range).tolist(),
        },
        "arcs": {"steering": ARC_STEERING.tolist(), "stations": ARC_STATIONS.tolist()},
        "network": {
            "normalised_limit": running_statistics.CLIP,
            "embedding": image,
            "squashed": isinstance(_learned(policy).actor, TanhNormalActor),
        },
        "base": None if base is None else {"name": _BASES[type(base)], **_numbers(base)},
        "vehicle": {name: float(getattr(vehicle, name)) for name in _SIZES},
        "ground_classes": STANDARD.names,
    }


def weights(policy: ResidualPolicy | DeterministicPolicy) -> dict[str, np.ndarray]:
    """Weights of the actor, by layer, and `mean` and `std` `[O]` of observations; float32."""
    learned = _learned(policy)
    leaves = jax.tree.leaves_with_path(learned.params["params"])
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    named.pop("log_std", None)  # which only exploration needs
    named |= {"mean": learned.observations.mean, "std": learned.observations.std}
    return {name: np.asarray(leaf, np.float32) for name, leaf in named.items()}


def _learned(policy: ResidualPolicy | DeterministicPolicy) -> DeterministicPolicy:
    return policy.correction if isinstance(policy, ResidualPolicy) else policy


def _part(part: Part) -> dict[str, Any]:
    where = [part.where.start, part.where.stop, part.where.step or 1]
    return {"slice": where, "unit": part.unit, "scale": part.scale}


def _numbers(base: Any) -> dict[str, Any]:
    """The settings of a controller, but for the environment's."""
    own = {field.name: getattr(base, field.name) for field in dataclasses.fields(base)}
    del own["config"]
    own.pop("steering_limit", None)  # that of the vehicle
    return {
        name: dataclasses.asdict(value) if isinstance(value, TraversabilityCost) else value
        for name, value in own.items()
    }
