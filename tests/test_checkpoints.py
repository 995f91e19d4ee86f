import resource
import signal
import subprocess
import sys
import time

import chex
import jax
import jax.numpy as jnp
import pytest

from vertiwm_jax import checkpoints
from vertiwm_jax.checkpoints import CheckpointError


def state(size=4):
    return {
        "weights": {"kernel": jnp.arange(3.0 * size).reshape(3, size), "bias": jnp.ones(size)},
        "step": jnp.int32(7),
        "keys": jax.random.split(jax.random.key(3), 2),
        "flags": jnp.array([True, False]),
    }


def test_what_is_loaded_is_what_was_saved(tmp_path):
    path = checkpoints.save(tmp_path, 7, state(), keep=2)
    assert path == tmp_path / "7"
    chex.assert_trees_all_equal(checkpoints.load(path, jax.eval_shape(state)), state())


def test_only_the_newest_are_kept(tmp_path):
    assert checkpoints.latest(tmp_path / "none") is None
    for step in (8, 9, 10, 11):
        checkpoints.save(tmp_path, step, state(), keep=2)
    assert checkpoints.latest(tmp_path) == tmp_path / "11"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["10", "11"]


def _wider():
    return state(size=5)


def _longer():
    return {**state(), "more": jnp.zeros(1)}


def _shorter():
    return {name: leaf for name, leaf in state().items() if name != "flags"}


def _other_type():
    return {**state(), "step": jnp.float32(7)}


@pytest.mark.parametrize(
    ("like", "message"),
    [
        (_wider, r"weights.bias: expected float32\[5\], found float32\[4\]"),
        (_longer, r"more: expected float32\[1\], found nothing"),
        (_shorter, r"flags: expected nothing, found bool\[2\]"),
        (_other_type, r"step: expected float32\[\], found int32\[\]"),
    ],
)
def test_a_checkpoint_of_another_shape_says_which_leaf(tmp_path, like, message):
    path = checkpoints.save(tmp_path, 7, state(), keep=1)
    with pytest.raises(CheckpointError, match=rf"^{path}: {message}.*$") as error:
        checkpoints.load(path, jax.eval_shape(like))
    assert "\n" not in str(error.value)


def test_what_is_no_checkpoint_is_said_so(tmp_path):
    (tmp_path / "3").mkdir()
    with pytest.raises(CheckpointError, match=f"^{tmp_path / '3'}: not a readable checkpoint"):
        checkpoints.load(tmp_path / "3", jax.eval_shape(state))


def test_a_full_disk_is_one_line_and_loses_nothing(tmp_path, capfd):
    good = checkpoints.save(tmp_path, 1, state(), keep=1)
    large = {"noise": jax.random.normal(jax.random.key(0), (200, 500))}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        with pytest.raises(CheckpointError, match=f"^{tmp_path / '2'}: cannot write") as error:
            checkpoints.save(tmp_path, 2, large, keep=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(error.value)
    assert f"the checkpoint {good} is still good" in str(error.value)
    assert "Traceback" not in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["1"]
    chex.assert_trees_all_equal(checkpoints.load(good, jax.eval_shape(state)), state())
    checkpoints.save(tmp_path, 2, large, keep=1)


def test_an_interrupted_write_is_waited_for(tmp_path, monkeypatch):
    """What it runs in the background would hang if Python ended before it."""
    asked = []
    begin = checkpoints.ocp.save_async

    class Interrupted:
        def __init__(self, *args):
            self.writing = begin(*args)

        def result(self):
            asked.append(self)
            if len(asked) == 1:
                raise KeyboardInterrupt
            self.writing.result()

    monkeypatch.setattr(checkpoints.ocp, "save_async", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        checkpoints.save(tmp_path, 1, state(), keep=1)
    assert len(asked) == 2
    chex.assert_trees_all_equal(checkpoints.load(tmp_path / "1", jax.eval_shape(state)), state())


WRITER = """
import sys, jax
from vertiwm_jax import checkpoints
def state(scale): return {"noise": scale * jax.random.normal(jax.random.key(0), (4000, 5000))}
checkpoints.save(sys.argv[1], 1, state(1.0), keep=1)
print("first", flush=True)
checkpoints.save(sys.argv[1], 2, state(2.0), keep=1)
"""


@pytest.mark.parametrize("kill", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.integration
def test_a_write_stopped_in_the_middle_leaves_a_good_checkpoint(tmp_path, kill):
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert writer.stdout is not None
    assert writer.stdout.readline() == "first\n"
    deadline = time.monotonic() + 30
    while len(list(tmp_path.iterdir())) < 2 and time.monotonic() < deadline:
        time.sleep(0.001)
    writer.send_signal(kill)
    writer.communicate(timeout=60)
    latest = checkpoints.latest(tmp_path)
    assert latest is not None
    noise = jax.random.normal(jax.random.key(0), (4000, 5000))
    expected = {"noise": noise * (1.0 if latest.name == "1" else 2.0)}
    chex.assert_trees_all_equal(checkpoints.load(latest, expected), expected)
    checkpoints.save(tmp_path, 3, {"next": jnp.ones(1)}, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["3"]
