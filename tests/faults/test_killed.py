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

drives = test_fit.folder
KILLS = 50
EVERY = 2
"""Iterations between checkpoints."""
TIMES = ("wall_time", "timesteps_per_second", "updates_per_second")
"""Metrics that are never the same."""
PPO = {
    "ppo.num-envs": 8,
    "ppo.num-steps": 4,
    "ppo.minibatches": 2,
    "ppo.total-timesteps": 32 * 24,
    "ground.train-worlds": 3,
    "ground.starts": 16,
    "ground.suites": "easy",
    "ground.suite-worlds": 1,
    "ground.pairs": 2,
    "loop.checkpoint-every": EVERY,
    "compute-dtype": "float32",
}
"""The default training, in few vehicles, steps, worlds and tasks."""
SHORT = "updates: 2, updates_per_iteration: 1, warm_up: 0"
LONGER = SHORT.replace("2", "5", 1) + f", checkpoints: {{checkpoint_every: {EVERY}, keep: 1}}"


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
        """Runs it to the end: s until it has written a first line of metrics, and altogether."""
        began, process, first = time.monotonic(), self.start(), 0.0
        while process.poll() is None:
            if not first and any(map(len, self.metrics().values())):
                first = time.monotonic() - began
            time.sleep(0.05)
        assert process.returncode == 0, self.said()
        return first, time.monotonic() - began

    def wait_for_more(self, process: subprocess.Popen) -> None:
        """Waits for the next line of metrics, or for the end."""

        def lines() -> int:
            return sum(map(len, self.metrics().values()))

        before = lines()
        while process.poll() is None and lines() <= before:
            time.sleep(0.02)

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
    argv += ["--compile-cache", str(tmp_path / "compiled")]
    for name in ("alone", "killed"):
        (tmp_path / name).mkdir()
    return [
        Command(request.param, tmp_path / name, tuple(argv), parts) for name in ("alone", "killed")
    ]


@pytest.mark.slow
def test_what_is_killed_goes_on(commands):
    alone, killed = commands
    alone.whole()  # Compiles.
    first, seconds = again(alone)
    rng, lost, begun, ended = random.Random(0), [], 0, 0
    while len(lost) < KILLS:
        process = killed.start()
        try:
            if rng.random() < 0.5:  # Before it goes on, or while it does.
                process.wait(rng.uniform(0, first))
            else:
                killed.wait_for_more(process)
                process.wait(rng.uniform(0, (seconds - first) / 2))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            begun += killed.run() is not None
            lost.append(killed.lost())
            assert lost[-1] <= EVERY, killed.said()
            continue
        assert process.returncode == 0, killed.said()
        ended += 1
        same(alone.result(), killed.result())
        (killed.folder / "runs").rename(killed.folder / f"ended_{ended}")
    killed.whole()
    same(alone.result(), killed.result())
    print(
        f"\n{killed.name}: {KILLS} kills, {begun} after a run had begun, in {ended + 1} runs of "
        f"{seconds:.0f} s, {first:.0f} s of them until the first iteration was done; lost were "
        f"{sum(lost)} iterations, {max(lost)} at most at once, with a checkpoint every {EVERY}"
    )


def again(command: Command) -> tuple[float, float]:
    """Times of the same once more, when all is compiled, which has to end the same."""
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
