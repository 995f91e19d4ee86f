"""Fast, differentiable world models for off-road reinforcement learning, in JAX."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vertiwm_jax.dynamics import Dynamics as Dynamics
    from vertiwm_jax.dynamics import rollout as rollout
    from vertiwm_jax.env.agent import Agent as Agent
    from vertiwm_jax.env.navigation import NavigationEnv as NavigationEnv
    from vertiwm_jax.env.navigation import make_env as make_env
    from vertiwm_jax.evaluation.navigation import evaluate as evaluate
    from vertiwm_jax.evaluation.prediction import prediction_errors as prediction_errors
    from vertiwm_jax.learning.dataset import load_drives as load_drives
    from vertiwm_jax.learning.experiment import fit as fit
    from vertiwm_jax.learning.identification import identify as identify
    from vertiwm_jax.mechanics.kinematic import place as place
    from vertiwm_jax.mechanics.vehicle import Vehicle as Vehicle
    from vertiwm_jax.mechanics.vehicle import load_vehicle as load_vehicle
    from vertiwm_jax.models.registry import load_model as load_model
    from vertiwm_jax.planning.mppi import MPPI as MPPI
    from vertiwm_jax.rl.experiment import train as train
    from vertiwm_jax.rl.policy import Policy as Policy
    from vertiwm_jax.rl.policy import load_policy as load_policy
    from vertiwm_jax.state import Command as Command
    from vertiwm_jax.state import VehicleState as VehicleState
    from vertiwm_jax.terrain.files import load_map as load_map
    from vertiwm_jax.terrain.map import TerrainMap as TerrainMap
    from vertiwm_jax.terrain.worlds import make_worlds as make_worlds

__version__ = "0.1.0"
_PUBLIC = {
    "Agent": "env.agent",
    "Command": "state",
    "Dynamics": "dynamics",
    "MPPI": "planning.mppi",
    "Policy": "rl.policy",
    "load_policy": "rl.policy",
    "train": "rl.experiment",
    "NavigationEnv": "env.navigation",
    "TerrainMap": "terrain.map",
    "Vehicle": "mechanics.vehicle",
    "VehicleState": "state",
    "evaluate": "evaluation.navigation",
    "fit": "learning.experiment",
    "identify": "learning.identification",
    "load_drives": "learning.dataset",
    "load_map": "terrain.files",
    "load_model": "models.registry",
    "load_vehicle": "mechanics.vehicle",
    "make_env": "env.navigation",
    "make_worlds": "terrain.worlds",
    "place": "mechanics.kinematic",
    "prediction_errors": "evaluation.prediction",
    "rollout": "dynamics",
}
__all__ = [*_PUBLIC]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Imports what is public when it is used (PEP 562)."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_PUBLIC]
