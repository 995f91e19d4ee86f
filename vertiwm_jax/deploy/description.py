"""The content of `policy.json` and `policy.npz`: what the numbers of a policy mean, and weights."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

import vertiwm_jax
from vertiwm_jax.checkpoints import named_leaves
from vertiwm_jax.env import observation
from vertiwm_jax.env.observation import ARC_STATIONS, ARC_STEERING
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.networks.policy import TanhNormalActor
from vertiwm_jax.rl import running_statistics
from vertiwm_jax.rl.policy import Policy
from vertiwm_jax.state import STEP_SECONDS, Command
from vertiwm_jax.terrain.classes import STANDARD

_SIZES = "length", "width", "wheelbase", "track", "ride_height", "steering_limit"


def about(policy: Policy) -> dict[str, Any]:
    """The content of `policy.json`: what observations, actions and weights mean."""
    vehicle, speed_range = policy.config.vehicle.vehicle, policy.task.speed_range
    still = Command(jnp.float32(0), jnp.float32(0))
    seen = policy.task.observed
    parts = {
        name: {"slice": part.where.indices(seen.size), "unit": part.unit, "scale": part.scale}
        for name, part in seen.parts.items()
    }
    return {
        "vertiwm_jax": vertiwm_jax.__version__,
        "step_seconds": STEP_SECONDS,
        "held_while_learning": policy.config.action_repeat,
        "observation": {
            "size": seen.size,
            "limit": observation.OBSERVATION_LIMIT,
            "parts": parts,
        },
        "action": {
            "speed_range": speed_range,
            "steering_limit": float(vehicle.steering_limit),
            "standing": vehicle.action(still, speed_range).tolist(),
        },
        "arcs": _arcs(vehicle) if seen.arcs else None,
        "network": {
            "normalised_limit": running_statistics.CLIP,
            "embedding": seen.layout.image,
            "squashed": isinstance(policy.learned.actor, TanhNormalActor),
        },
        "base": policy.base and {"name": policy.config.base, **_numbers(policy.base)},
        "vehicle": {name: float(getattr(vehicle, name)) for name in _SIZES},
        "ground_classes": STANDARD.names,
    }


def weights(policy: Policy) -> dict[str, np.ndarray]:
    """Float32 weights of the actor by layer, and `mean` and `std` `[O]` of observations."""
    learned = policy.learned
    named = named_leaves(learned.params["params"])
    named.pop("log_std", None)  # Only exploration needs it.
    named |= {"mean": learned.observations.mean, "std": learned.observations.std}
    return {name: np.asarray(leaf, np.float32) for name, leaf in named.items()}


def _arcs(vehicle: Vehicle) -> dict[str, Any]:
    """Where the observation shows the ground ahead."""
    places, heading = observation.poses_ahead(vehicle)
    return {
        "steering": ARC_STEERING.tolist(),
        "stations": ARC_STATIONS.tolist(),
        "places": np.column_stack([places, heading]).tolist(),
        "class_places": observation.CLASS_PLACES.tolist(),
    }


def _numbers(base: Any) -> dict[str, Any]:
    """The settings of a controller, but for those of environment and vehicle."""
    own = dataclasses.asdict(base)
    return {name: own[name] for name in own if name not in ("config", "steering_limit")}
