"""The default training, inside the simulator, on 1 to 8 devices of a CPU and in two processes.

Each training is the command itself, on few worlds: how fast it learns, and how far what it has
learned is from what one device learned. Devices beyond the cores share them. Two processes
exchange data by gloo. Driving over rough ground magnifies every rounding, so one device also
learns with a learning rate that is larger by a rounding, to show what that alone changes.
"""

import os
import socket
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks._harness import Figures, parser, report
from vertiwm_jax import runs
from vertiwm_jax.rl.experiment import PPOTraining

_FEW_WORLDS = "--ground.suites easy --ground.suite-worlds 1 --ground.train-worlds 20"
_ROUNDED = "1 x 1, rounded"


def train(processes: int, devices: int, options: list[str], folder: Path) -> Path:
    """Trains in processes that have so many devices each, and gives the run's folder."""
    command = [sys.executable, "-m", "vertiwm_jax.ppo", *_FEW_WORLDS.split(), *options]
    shared = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(devices)}
    each = [shared]
    if processes > 1:
        with socket.socket() as free:
            free.bind(("localhost", 0))
            shared["JAX_COORDINATOR_ADDRESS"] = f"localhost:{free.getsockname()[1]}"
        shared["JAX_NUM_PROCESSES"] = str(processes)
        each = [shared | {"JAX_PROCESS_ID": str(number)} for number in range(processes)]
    started = [
        subprocess.Popen([*command, "--runs", str(folder)], env=given, stdout=subprocess.DEVNULL)
        for given in each
    ]
    if any([process.wait() for process in started]):
        raise RuntimeError(f"the training in {processes} processes of {devices} devices failed")
    (run,) = folder.iterdir()
    return run


def learned(run: Path) -> tuple[float, np.ndarray, np.ndarray]:
    """Transitions a second, mean rewards `[iteration]`, and the policy's weights `[weight]`."""
    columns = runs.read_columns(run)
    with np.load(run / "policy" / "weights.npz") as weights:
        names = sorted(name for name in weights if name.startswith("actor"))
        policy = np.concatenate([weights[name].ravel() for name in names])
    return statistics.median(columns["timesteps_per_second"]), np.array(columns["reward"]), policy


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one - other) / np.linalg.norm(other))


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--devices", type=int, nargs="+", default=[2, 4, 8], help="beside one")
    arguments.add_argument("--iterations", type=int, default=5)
    chosen = arguments.parse_args()
    usual = PPOTraining().ppo
    steps = usual.num_envs * usual.num_steps * PPOTraining().action_repeat
    options = ["--ppo.total-timesteps", str(chosen.iterations * steps), "--model", "builtin"]
    larger = ["--ppo.learning-rate", str(usual.learning_rate * (1 + 2**-23))]
    cases = {f"1 x {devices}": (1, devices, options) for devices in (1, *chosen.devices)}
    cases["2 x 1"] = 2, 1, options
    cases[_ROUNDED] = 1, 1, [*options, *larger]
    with tempfile.TemporaryDirectory() as folder:
        found = {name: learned(train(*case, Path(folder) / name)) for name, case in cases.items()}
    _, rewards, weights = next(iter(found.values()))
    results: dict[str, Figures] = {
        name: {
            "transitions_per_s": rate,
            "first_reward_apart": _apart(reward[0], rewards[0]),
            "last_reward_apart": _apart(reward[-1], rewards[-1]),
            "weights_apart": _apart(weight, weights),
        }
        for name, (rate, reward, weight) in found.items()
    }
    report("devices", results, chosen.json)


if __name__ == "__main__":
    main()
