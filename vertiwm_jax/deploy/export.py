"""A learned policy as a folder of files that robots can run."""

import io
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vertiwm_jax import atomic
from vertiwm_jax.deploy import description, run_policy, stablehlo
from vertiwm_jax.errors import needs
from vertiwm_jax.models.registry import load_encoders
from vertiwm_jax.rl.policy import Policy, load_policy


def export(run: Path, output: Path | None = None, seed: int = 0) -> Path:
    """Writes what a run has learned as robots can run it: StableHLO, ONNX, and NumPy alone.

    Args:
        run: folder of a policy's training, or of a policy.
        output: folder to make; `export` in that of the run by default.
        seed: which of the policies that the run trained side by side.

    Returns:
        The folder.

    Raises:
        UserError: the package `onnx` is missing, or the policy cannot be read.
        WriteError: the folder exists or cannot be written.
    """
    policy, folder = load_policy(run, seed), output or run / "export"
    with atomic.new_folder(folder) as unfinished:
        for file, data in files(policy).items():
            atomic.write(unfinished / file, data)
    return folder


def files(policy: Policy) -> dict[str, bytes | str]:
    """What the exported folder of a policy holds, by file name; `UserError` without `onnx`."""
    with needs("onnx", "export", "policy.onnx"):
        from vertiwm_jax.deploy.onnx_graph import record
    about = description.about(policy)
    weights: dict[str, Any] = dict(description.weights(policy))
    arrays = io.BytesIO()
    np.savez(arrays, **weights)
    size = about["observation"]["size"]
    task, vehicle = policy.task, policy.config.vehicle.vehicle
    encoders = load_encoders(policy.config.weights) if task.embeddings else None
    return {
        "policy.json": json.dumps(about, indent=1) + "\n",
        "policy.npz": arrays.getvalue(),
        "policy.onnx": record(partial(run_policy.act, about, weights), size, 2),
        "policy.stablehlo": stablehlo.policy(policy, size, about["action"]["standing"]),
        "route.stablehlo": stablehlo.route(task, vehicle),
        "observe.stablehlo": stablehlo.observe(task, vehicle, encoders),
        "run_policy.py": Path(run_policy.__file__).read_bytes(),
    }
