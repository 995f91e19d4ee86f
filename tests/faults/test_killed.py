"""Commands that are killed at random moments, and go on, end as if nothing had happened.

`python -m pytest -m slow -s tests/faults/test_killed.py` prints what was lost.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from integration import test_fit
from integration.test_fit import STAGES, TINY

from vertiwm_jax import checkpoints
from vertiwm_jax.models import files
from vertiwm_jax.rl import policy
from vertiwm_jax.training import CheckpointConfig

drives = test_fit.folder
KILLS = 50
EVERY = CheckpointConfig().checkpoint_every
"""Iterations between checkpoints, as by default."""
TIMES = ("wall_time", "timesteps_per_second", "updates_per_second")
"""Metrics that are never the same."""
PPO = {
    "ppo.num-envs": 8,
    "ppo.num-steps": 4,
    "ppo.minibatches": 2,
    "ppo.total-timesteps": 8 * 4 * 8 * 200,  # 8 steps an action
    "ground.train-worlds": 3,
    "ground.starts": 16,
    "ground.suites": "easy",
    "ground.suite-worlds": 1,
    "ground.pairs": 2,
    "compute-dtype": "float32",
}
"""The default training with few vehicles, worlds and tasks: 200 iterations."""
SHORT = "updates: 2, updates_per_iteration: 1, warm_up: 0"
LONGER = SHORT.replace("2", "60", 1)


@dataclass
class Command:
    """A command in a folder of its own: how it begins, and which parts of its run have metrics."""

    name: str
    folder: Path
    argv: tuple[str, ...]
    parts: tuple[str, ...]

    def run(self) -> Path | None:
        """The folder of the run that was begun, if it can go on."""
        runs = sorted(self.folder.glob("runs/*/config.yaml"))
        return runs[-1].parent if runs else None

    def start(self) -> subprocess.Popen:
        """Begins, or goes on."""
        argv = [*self.argv, "--runs", self.folder / "runs"]
        if begun := self.run():
            argv = ["--resume", begun]
        command = [sys.executable, "-m", f"vertiwm_jax.{self.name}", *map(str, argv)]
        log = (self.folder / "log.txt").open("a")
        return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)

    def whole(self) -> tuple[float, float]:
        """Runs it to the end: s until its first line of metrics, and from there to its last."""
        began, process = time.time(), self.start()
        self.wait_until_it_learns(process, began)
        first = time.time()
        assert process.wait() == 0, self.said()
        return first - began, self.last() - first

    def wait_until_it_learns(self, process: subprocess.Popen, began: float) -> None:
        while process.poll() is None and self.last() <= began:
            time.sleep(0.02)

    def last(self) -> float:
        """When it wrote the last line of metrics, in s as `time.time`."""
        return max(
            (lines[-1]["wall_time"] for lines in self.metrics().values() if lines), default=0
        )

    def iterations(self) -> int:
        return sum(map(len, self.metrics().values()))

    def said(self) -> str:
        return (self.folder / "log.txt").read_text()[-2000:]

    def metrics(self) -> dict[str, list[dict]]:
        """Whole lines of metrics, by part of the run."""
        run, found = self.run(), {}
        for part in self.parts if run else ():
            file = run / part / "metrics.jsonl"
            text = file.read_text() if file.is_file() else ""
            # A last line without its end is still being written.
            found[part] = [json.loads(line) for line in text.split("\n")[:-1]]
        return found

    def lost(self) -> int:
        """Iterations that were done and are in no checkpoint, of the part where they are most."""
        run, most = self.run(), 0
        for part, lines in self.metrics().items():
            newest = checkpoints.latest(run / part / "checkpoints")
            most = max(most, len(lines) - (int(newest.name) if newest else 0))
        return most

    def result(self) -> tuple[dict, dict]:
        """All metrics but times, and all arrays that it has learned."""
        metrics = {
            part: [{name: x for name, x in line.items() if name not in TIMES} for line in lines]
            for part, lines in self.metrics().items()
        }
        run = self.run()
        if self.name == "fit":
            return metrics, checkpoints.named_leaves(files.load(run / "model")[1])
        with np.load(run / policy.FOLDER / "weights.npz") as weights:
            return metrics, dict(weights)


@pytest.fixture(params=["ppo", "fit"])
def commands(request, tmp_path, drives):
    """Two of the same: one that is left alone, and one that is killed."""
    if request.param == "ppo":
        argv, parts = [str(x) for name, value in PPO.items() for x in (f"--{name}", value)], (".",)
    else:
        (tmp_path / "tiny.yaml").write_text(TINY.replace(SHORT, LONGER))
        argv = ["--config", str(tmp_path / "tiny.yaml"), "--data", str(drives / "drives")]
        parts = STAGES
    for name in ("alone", "killed"):
        (tmp_path / name).mkdir()
    return [
        Command(request.param, tmp_path / name, tuple(argv), parts) for name in ("alone", "killed")
    ]


@pytest.mark.slow
def test_what_is_killed_goes_on(commands):
    alone, killed = commands
    alone.whole()  # Compiles.
    first, learning = again(alone)
    rng, kills, lost, ended = random.Random(0), 0, [], 0
    while kills < KILLS:
        began, process = time.time(), killed.start()
        try:
            if rng.random() < 0.1:  # Before it learns, or goes on to.
                process.wait(rng.uniform(0, first))
            else:
                killed.wait_until_it_learns(process, began)
                process.wait(rng.uniform(0, learning / 3))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
            assert killed.lost() <= EVERY, killed.said()
            if killed.last() > began:
                lost.append(killed.lost())
            continue
        assert process.returncode == 0, killed.said()
        ended += 1
        same(alone.result(), killed.result())
        (killed.folder / "runs").rename(killed.folder / f"ended_{ended}")
    killed.whole()
    same(alone.result(), killed.result())
    iterations = alone.iterations()
    print(
        f"\n{killed.name}: {kills} kills, {len(lost)} of them when it had learned since its start, "
        f"in {ended + 1} runs; {sum(map(bool, lost))} lost {sum(lost)} iterations, at most "
        f"{max(lost)} at once; a run has {iterations} in {learning:.0f} s, and a checkpoint every "
        f"{EVERY} ({learning * EVERY / iterations:.1f} s)"
    )


def again(command: Command) -> tuple[float, float]:
    """`whole` of the same once more, when all is compiled, which has to end the same."""
    expected = command.result()
    (command.folder / "runs").rename(command.folder / "first")
    times = command.whole()
    same(expected, command.result())
    return times


def same(expected: tuple[dict, dict], found: tuple[dict, dict]) -> None:
    assert expected[0] == found[0]
    assert expected[1].keys() == found[1].keys()
    for name, array in expected[1].items():
        np.testing.assert_array_equal(found[1][name], array, err_msg=name)
