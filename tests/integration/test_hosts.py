"""Two processes, as of two hosts, train as one with two devices does; `trainee.py` is what runs."""

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import chex
import jax
import pytest
import trainee
from doors import door

from vertiwm_jax import checkpoints, runs

ITERATIONS = trainee.STOPPED + 3
TESTS = Path(__file__).parents[1]
# To import the trainee starts JAX.
TRAINEE = "-c", "from vertiwm_jax import hosts; hosts.join('ppo'); import trainee; trainee.main()"
TINY = """
ground: {train_worlds: 2, suites: [easy], suite_worlds: 1, starts: 8, pairs: 16}
navigation: {horizon_seconds: 3, settle_steps: 2}
simulator: {substeps: 1}
model: builtin
action_repeat: 2
planning: null
ppo: {total_timesteps: 512, num_envs: 16, num_steps: 8, minibatches: 2, epochs: 1, hidden: [8]}
"""


def together(*argv: object) -> list[tuple[int, str, str]]:
    """Status, output and errors of the processes of two hosts, given what Python is to run."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    shared = {
        "PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)]),
        "JAX_NUM_CPU_DEVICES": "1",
        "JAX_COORDINATOR_ADDRESS": f"localhost:{port}",
        "JAX_NUM_PROCESSES": "2",
    }
    processes = [
        subprocess.Popen(
            [sys.executable, *map(str, argv)],
            env={**os.environ, **shared, "JAX_PROCESS_ID": str(process)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for process in range(2)
    ]
    try:
        ends = [process.communicate(timeout=300) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(process.returncode, *end) for process, end in zip(processes, ends, strict=True)]


def numbers(run):
    """Metrics of all iterations."""
    timed = ("wall_time", "timesteps_per_second")
    lines = runs.read_metrics(run)
    return [{name: line[name] for name in line if name not in timed} for line in lines]


def learned(run):
    """Metrics of all iterations, and weights at the end."""
    lines = numbers(run)
    algorithm, data = trainee.PPO(trainee.Target(), trainee.CONFIG), trainee.ProbeParams()
    restored = trainee.restore(trainee.Seeds(algorithm, 1), data, run)
    assert restored is not None and restored[0] == len(lines) == ITERATIONS
    return lines, restored[1].params


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """Of one process with two devices."""
    assert jax.device_count() == 2
    return learned(trainee.trained(tmp_path_factory.mktemp("one"), ITERATIONS))


def test_what_one_host_is_told_to_stop_all_have_saved_and_one_process_goes_on(tmp_path, expected):
    first, other = together(*TRAINEE, tmp_path, 1000, int(signal.SIGTERM))
    assert first[0] == other[0] == 130, first[2] + other[2]
    assert "compiling for 2 of 2 devices ..." in first[1]
    assert f"stopped after iteration {trainee.STOPPED} of 1000, all saved" in first[1]
    assert "iteration" not in other[1]
    [run] = tmp_path.iterdir()
    latest = checkpoints.latest(run / "checkpoints")
    assert latest is not None and latest.name == str(trainee.STOPPED)
    trainee.trained(run, ITERATIONS)
    chex.assert_trees_all_close(learned(run), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.slow
def test_where_one_host_is_lost_others_end_and_two_go_on_from_the_checkpoint(tmp_path, expected):
    first, other = together(*TRAINEE, tmp_path, 1000, int(signal.SIGKILL))
    assert other[0] == -signal.SIGKILL
    assert first[0] == 1 and "error: another host has stopped" in first[2], first[2]
    [run] = tmp_path.iterdir()
    latest = checkpoints.latest(run / "checkpoints")
    assert latest is not None and latest.name == str(trainee.STOPPED - 1)
    first, other = together(*TRAINEE, run, ITERATIONS)
    assert first[0] == other[0] == 0, first[2] + other[2]
    chex.assert_trees_all_close(learned(run), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.slow
def test_a_command_on_two_hosts_leaves_one_run_that_is_the_one_of_one_process(tmp_path):
    (tmp_path / "tiny.yaml").write_text(TINY)
    argv = "--config", str(tmp_path / "tiny.yaml"), "--runs"
    first, other = together("-m", "vertiwm_jax.ppo", *argv, tmp_path / "two")
    assert first[0] == other[0] == 0, first[2] + other[2]
    assert "all of it is in" in first[1] and "all of it" not in other[1]
    door("ppo")([*argv, str(tmp_path / "one")])
    [two], [one] = (list((tmp_path / name).iterdir()) for name in ("two", "one"))
    assert len(numbers(two)) == 2
    chex.assert_trees_all_close(numbers(two), numbers(one), rtol=2e-4, atol=2e-5)
    files = [{path.name.partition(".tf")[0] for path in run.iterdir()} for run in (two, one)]
    assert files[0] == files[1] and "summary.md" in files[0]


@pytest.mark.parametrize(
    ("command", "process", "message"),
    [
        ("evaluate", "0", "evaluate: expected one process, found JAX_COORDINATOR_ADDRESS="),
        ("ppo", "one", "cannot join, found .*JAX_PROCESS_ID=one: invalid literal .* 'one'"),
        ("ppo", "7", "cannot join, found .*JAX_PROCESS_ID=7.*: process_id and num_processes"),
    ],
)
def test_what_cannot_be_joined_is_said_in_one_line(command, process, message):
    variables = {"JAX_COORDINATOR_ADDRESS": "localhost:1", "JAX_NUM_PROCESSES": "2"}
    found = subprocess.run(
        [sys.executable, "-m", f"vertiwm_jax.{command}"],
        env={**os.environ, **variables, "JAX_PROCESS_ID": process},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 1
    assert re.fullmatch(rf"error: .*{message}.*\n", found.stderr), found.stderr
