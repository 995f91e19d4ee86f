"""Every model of this package by name, for commands that let their users choose."""

from pathlib import Path
from typing import Literal

from vertiwm_jax.dynamics import Dynamics, Params
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.world_model import model

ModelName = Literal["builtin", "transformer", "nesam", "vertiwm"]
"""The simulator, which has learned nothing; either specialist; both of them fused."""


def choose(name: ModelName, weights: Path | None = None) -> tuple[Dynamics, Params]:
    """The model and its parameters, for Chrono's HMMWV.

    weights: folder of a fitted model; the one that comes with the package by default. Raises what
    `model.load` raises.
    """
    if name == "builtin":
        return Simulator(), chrono_like(hmmwv())
    fused, params = model.load(weights or model.PRETRAINED)
    return {
        "transformer": (fused.transformer, params.transformer),
        "nesam": (fused.nesam, params.nesam),
        "vertiwm": (fused, params),
    }[name]
