"""A learned policy as a folder of files that robots can run."""

import io
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vertiwm_jax import atomic
from vertiwm_jax.config import ConfigError
from vertiwm_jax.deploy import description, run_policy, stablehlo
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics.vehicle import Vehicle
from vertiwm_jax.models.registry import load_encoders
from vertiwm_jax.perception.features import Encoders
from vertiwm_jax.rl.learned import DeterministicPolicy, ResidualPolicy
from vertiwm_jax.rl.policy import load_policy

Record = Callable[..., bytes]


def export(run: Path, folder: Path, seed: int = 0) -> None:
    """Writes what a run has learned as StableHLO, as ONNX, and for NumPy alone.

    Args:
        run: folder of a policy's training, or of a policy.
        folder: to make.
        seed: which of the policies that the run trained side by side.

    Raises:
        ConfigError: the package `onnx` is missing, or the policy cannot be read.
        WriteError: the folder exists or cannot be written.
    """
    record, policy = _recorder(), load_policy(run, seed)
    config = policy.config
    seen_by = load_encoders(config.weights) if policy.task.embeddings else None
    told = policy.task, config.vehicle.vehicle, config.action_repeat
    with atomic.new_folder(folder) as unfinished:
        for file, data in files(policy.acting, seen_by, *told, record).items():
            atomic.write(unfinished / file, data)


def files(
    policy: ResidualPolicy | DeterministicPolicy,
    encoders: Encoders | None,
    config: NavigationConfig,
    vehicle: Vehicle,
    held: int,
    record: Record,
) -> dict[str, bytes | str]:
    """What the folder of a policy holds, by name.

    encoders: of a policy that sees embeddings; config, vehicle, held: as in `description.about`;
    record: `onnx_graph.record`.
    """
    about = description.about(policy, config, vehicle, held)
    weights: dict[str, Any] = dict(description.weights(policy))
    arrays = io.BytesIO()
    np.savez(arrays, **weights)
    size = about["observation"]["size"]
    return {
        "policy.json": json.dumps(about, indent=1) + "\n",
        "policy.npz": arrays.getvalue(),
        "policy.onnx": record(partial(run_policy.act, about, weights), size, 2),
        # The key is not used: no learned policy is random.
        "policy.stablehlo": stablehlo.policy(lambda seen: policy(seen, jax.random.key(0)), size),
        "route.stablehlo": stablehlo.route(config, vehicle),
        "observe.stablehlo": stablehlo.observe(config, vehicle, encoders),
        "run_policy.py": Path(run_policy.__file__).read_bytes(),
    }


def _recorder() -> Record:
    try:
        from vertiwm_jax.deploy.onnx_graph import record
    except ImportError as error:
        raise ConfigError(
            f"policy.onnx: expected the package onnx to write it, found: {error}; "
            'pip install "vertiwm-jax[export]"'
        ) from None
    return record
