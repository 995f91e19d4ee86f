"""`python -m benchmarks.devices` compares trainings with that of one device."""

import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import devices

LEARNED = {("1", False): 1.0, ("2", False): 1.25, ("1", True): 1.5}
"""Weights, by the number of devices and whether a learning rate is asked for."""


@pytest.fixture
def started(monkeypatch):
    """Environments of all processes that were started, each of which leaves what it learned."""
    environments = []

    class Training:
        def __init__(self, command, env, **_):
            environments.append(env)
            options = dict(itertools.pairwise(command))
            found = LEARNED[env["JAX_NUM_CPU_DEVICES"], "--ppo.learning-rate" in options]
            if env.get("JAX_PROCESS_ID", "0") == "0":
                run = Path(options["--runs"]) / "ppo-1"
                (run / "policy").mkdir(parents=True)
                numbers = {"step": 1, "reward": found, "timesteps_per_second": 10.0}
                (run / "metrics.jsonl").write_text(json.dumps(numbers) + "\n")
                weights = {"actor.bias": np.full(2, found), "observation_count": np.float32(1e6)}
                np.savez(run / "policy" / "weights.npz", **weights)

        def wait(self):
            return 0

    monkeypatch.setattr(subprocess, "Popen", Training)
    return environments


def test_trainings_are_compared_with_that_of_one_device(started, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["devices", "--json", "--devices", "2"])
    devices.main()
    results = json.loads(capsys.readouterr().out)["results"]
    apart = {name: figures["weights_apart"] for name, figures in results.items()}
    assert apart == {"1 x 1": 0, "1 x 2": 0.25, "2 x 1": 0, "1 x 1, rounded": 0.5}
    assert results["1 x 2"]["last_reward_apart"] == 0.25
    pair = [env for env in started if "JAX_PROCESS_ID" in env]
    assert [env["JAX_PROCESS_ID"] for env in pair] == ["0", "1"]
    assert len({env["JAX_COORDINATOR_ADDRESS"] for env in pair}) == 1


def test_a_training_that_failed_is_told(started, monkeypatch, tmp_path):
    monkeypatch.setattr(subprocess.Popen, "wait", lambda self: 1)
    with pytest.raises(RuntimeError, match="1 processes of 2 devices"):
        devices.train(1, 2, [], tmp_path)
