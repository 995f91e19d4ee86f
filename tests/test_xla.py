"""Options that the installed XLA does not know are left out and told, and never end a process.

Nor does what is kept of compiled programs, whatever is found there.
"""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from vertiwm_jax import xla

KNOWN, UNKNOWN = "xla_backend_optimization_level", "xla_no_such_option"


@pytest.fixture(autouse=True)
def _forget(monkeypatch):
    monkeypatch.setattr(xla, "_left_out", set())
    xla.brief_options.cache_clear()
    yield
    xla.brief_options.cache_clear()


def test_flags_that_xla_does_not_know_are_left_out(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=1")
    xla.add_flags({KNOWN: 1, UNKNOWN: 1, "xla_force_host_platform_device_count": 2})
    assert os.environ["XLA_FLAGS"] == f"--xla_force_host_platform_device_count=1 --{KNOWN}=1"
    assert UNKNOWN in xla._left_out and KNOWN not in xla._left_out


def test_flags_that_stand_there_are_not_tried_again(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"--{KNOWN}=1")
    monkeypatch.setattr(xla, "_accepts", lambda flags: pytest.fail("another process was started"))
    xla.add_flags({KNOWN: 2})
    assert os.environ["XLA_FLAGS"] == f"--{KNOWN}=1"


def test_an_unknown_flag_ends_a_process_and_so_has_to_be_tried():
    environment = {**os.environ, "XLA_FLAGS": f"--{UNKNOWN}=1"}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    assert subprocess.run(command, env=environment, capture_output=True).returncode != 0


def test_compiler_options_that_xla_does_not_know_are_left_out(monkeypatch):
    monkeypatch.setattr(xla, "_BRIEF", {KNOWN: 1, UNKNOWN: 1})
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    assert xla.brief_options() == {KNOWN: 1} and xla._left_out == {UNKNOWN}
    with pytest.raises(jax.errors.JaxRuntimeError, match=UNKNOWN):
        jax.jit(lambda x: 2 * x, compiler_options={UNKNOWN: 1})(jnp.float32(1))


def test_compiler_options_that_flags_set_are_left_as_they_are(monkeypatch):
    monkeypatch.setattr(xla, "_BRIEF", {KNOWN: 1})
    monkeypatch.setenv("XLA_FLAGS", f"--{KNOWN}=0")
    assert xla.brief_options() == {}


TWICE = """
from collections import Counter
import jax, jax.numpy as jnp
from vertiwm_jax import xla

seen = Counter()
jax.monitoring.register_event_listener(lambda event, **_: seen.update([event]))
xla.keep_compiled()
assert jax.jit(lambda x: 2 * x)(jnp.float32(3)) == 6
print(seen["/jax/compilation_cache/cache_hits"], seen["/jax/compilation_cache/cache_misses"])
"""


@pytest.fixture
def twice(tmp_path):
    """Doubles a number in a process that keeps programs; says how many it found and missed."""

    def run(**changed):
        environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache"), **changed}
        del environment["JAX_COMPILATION_CACHE_DIR"]
        done = subprocess.run(
            [sys.executable, "-c", TWICE], env=environment, check=True, capture_output=True
        )
        return [int(word) for word in done.stdout.split()]

    return run


def test_programs_are_kept_in_the_folder_of_the_user(twice, tmp_path):
    found, missed = twice()
    assert found == 0 and missed > 0
    assert twice() == [missed, 0]
    (folder,) = (tmp_path / "cache" / "vertiwm_jax").iterdir()
    assert folder.name == f"programs-{xla.cpu()}"
    for file in folder.glob("*-cache"):
        file.write_bytes(b"damaged")
    assert twice()[0] == 0


def test_programs_are_kept_nowhere_if_so_told(twice, tmp_path):
    assert twice(JAX_ENABLE_COMPILATION_CACHE="false") == [0, 0]
    assert not [*(tmp_path / "cache").rglob("*-cache")]


def test_a_folder_that_cannot_be_made_keeps_nobody_from_working(twice, tmp_path):
    (tmp_path / "cache").write_text("a file")
    assert twice()[0] == 0
