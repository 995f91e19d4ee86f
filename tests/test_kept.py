"""Programs are kept for later processes, which find those that are decided by the same."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import Mesh

from vertiwm_jax import kept, machine, runs, xla
from vertiwm_jax.env import controllers
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.observation import ARCS
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics.simulator import Simulator
from vertiwm_jax.rl.experiment import PPOTraining
from vertiwm_jax.rl.ppo import PPOConfig
from vertiwm_jax.training import Seeds

TINY = """
ground: {train_worlds: 2, suites: [easy], suite_worlds: 1, starts: 8, pairs: 1}
model: builtin
simulator: {substeps: 1}
navigation: {settle_steps: 1, horizon_seconds: 2}
action_repeat: 2
ppo: {total_timesteps: 64, num_envs: 8, num_steps: 4, minibatches: 2, epochs: 1, hidden: [8]}
"""
ENV = NavigationEnv(Simulator(), NavigationConfig())


@pytest.mark.parametrize(
    "other",
    [
        replace(ENV, action_repeat=2),
        replace(ENV, dynamics=Simulator(substeps=3)),
        replace(ENV, config=NavigationConfig(goal_radius=7.0)),
        replace(ENV, base=controllers.LookAhead(NavigationConfig())),
        replace(ENV, base=controllers.LookAhead(NavigationConfig(), speed=3.0)),
    ],
    ids=["steps", "model", "task", "controller", "its speed"],
)
def test_what_decides_a_program_tells_it_from_others(other):
    assert kept.identity(replace(other)) == kept.identity(other) != kept.identity(ENV)


def test_settings_of_the_algorithm_decide_its_program():
    usual, other = (PPOTraining(ppo=PPOConfig(learning_rate=rate)) for rate in (1e-3, 1e-4))
    same, *others = (kept.identity(Seeds(x.algorithm(ENV), 1)) for x in (usual, usual, other))
    assert same == others[0] != others[1]


def test_numbers_of_other_kinds_are_others():
    numbers = (1, 1.0, True, "1", None, np.float32(1), jnp.ones(()), np.ones(1), (1,), [1], {1: 1})
    assert len({repr(kept.identity(x)) for x in numbers}) == len(numbers)
    assert kept.identity(partial(ARCS.split)) != kept.identity(ARCS.split)


@struct.dataclass
class Elsewhere:
    """Of another package, whose source is not looked at."""


@pytest.mark.parametrize("x", [lambda: 0, Elsewhere(), object(), os.path.join, partial(np.sort)])
def test_what_cannot_be_recognized_is_not_told(x):
    with pytest.raises(kept._CannotTell):
        kept.identity((ENV, x))


@pytest.fixture
def folder(tmp_path):
    """In which programs are kept, beside those of JAX's cache."""
    names = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
    before = [getattr(jax.config, name) for name in names]

    def use(values):
        for name, value in zip(names, values, strict=True):
            jax.config.update(name, value)
        compilation_cache.reset_cache()

    use([str(tmp_path), 0])
    yield tmp_path / "ready"
    use(before)


def doubled(decided_by):
    """Twice 3 by a program, and whether it was compiled."""
    compiled = []

    def compiles():
        compiled.append(True)
        given = jax.ShapeDtypeStruct((2,), jnp.float32)
        return jax.jit(lambda x: {"double": 2 * x}).lower(given).compile()

    mesh = Mesh(np.array(jax.devices()[:1]), ("batch",))
    found = kept.program(decided_by, mesh, compiles)(jnp.full(2, 3.0))
    chex.assert_trees_all_equal(found, {"double": jnp.full(2, 6.0)})
    return bool(compiled)


def test_a_program_is_compiled_once(folder, monkeypatch):
    assert doubled(ENV) and not doubled(replace(ENV))
    assert doubled(replace(ENV, action_repeat=2)) and len(list(folder.iterdir())) == 2
    monkeypatch.setattr(kept, "_source", lambda: ("changed",))
    assert doubled(ENV)


def test_a_damaged_program_is_compiled_anew(folder):
    assert doubled(ENV)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"something else"):
        file.write_bytes(damaged)
        assert doubled(ENV) and not doubled(ENV)


def test_a_program_that_the_cache_of_jax_has_is_kept_whole(folder):
    """What JAX reads from there would be written without its functions, and fail when called."""
    assert doubled(object())  # By JAX's cache alone.
    jax.clear_caches()
    assert doubled(ENV) and not doubled(ENV)


def test_what_cannot_be_kept_is_compiled(folder, monkeypatch):
    assert doubled(object()) and doubled(object()) and not folder.exists()
    folder.write_text("a file")
    assert doubled(ENV) and doubled(ENV)
    folder.unlink()
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        assert doubled(ENV) and doubled(ENV) and not folder.exists()
    finally:
        jax.config.update("jax_enable_compilation_cache", True)


def test_those_used_longest_ago_go(folder, monkeypatch):
    monkeypatch.setattr(kept, "_PROGRAMS", 2)
    assert doubled(1) and doubled(2)
    for age, file in enumerate(sorted(folder.iterdir(), key=os.path.getmtime, reverse=True)):
        os.utime(file, (1e9 - age, 1e9 - age))
    assert not doubled(1) and doubled(3)  # 2 is the older one now.
    assert not doubled(1) and doubled(2)


traced = []


@partial(kept.jit, static_argnames="times")
def multiplied(x, times=2):
    traced.append(times)
    return {"product": times * x["factor"]}


@pytest.fixture
def tracings(folder, monkeypatch):
    """Of `multiplied`, where programs are kept."""
    monkeypatch.setattr(xla, "_keeps", True)
    monkeypatch.setattr(kept, "_KNOWN", kept._KNOWN | {__name__.split(".")[0]})
    traced.clear()
    yield traced
    kept.forget()


def test_a_later_process_does_not_trace_a_brief_program(folder, tracings):
    def product(x, *times):
        return multiplied({"factor": jnp.asarray(x)}, *times)["product"].tolist()

    assert product([1.0, 2.0]) == [2, 4] and product([3.0, 4.0]) == [6, 8] and tracings == [2]
    machine.forget_programs()
    assert product([5.0, 6.0]) == [10, 12] and product([1.0, 1.0], 2) == [2, 2]
    assert tracings == [2] and len([*folder.iterdir()]) == 1
    # Other numbers of other types or with other settings are other programs.
    assert product([1, 2]) == [2, 4] and product([1.0, 2.0, 3.0]) == [2, 4, 6]
    assert product([1.0, 2.0], 3) == [3, 6] and tracings == [2, 2, 2, 3]


def test_brief_programs_follow_their_arguments_to_devices(folder, tracings):
    first, second = jax.devices()[:2]
    for device in (first, second):
        given = jax.device_put(jnp.ones(2), device)
        assert multiplied({"factor": given})["product"].devices() == {device}
    mesh = Mesh(np.array([first, second]), ("batch",))
    rows = jax.NamedSharding(mesh, jax.P("batch"))
    for _ in range(2):
        with jax.set_mesh(mesh):
            product = multiplied({"factor": jax.device_put(jnp.arange(2.0), rows)})["product"]
        assert product.sharding == rows and product.tolist() == [0, 2]
        assert len([*folder.iterdir()]) == 3
        machine.forget_programs()


def test_a_brief_program_is_kept_only_if_asked(folder, tracings, monkeypatch):
    monkeypatch.setattr(xla, "_keeps", False)
    assert multiplied({"factor": jnp.float32(2)})["product"] == 4 and not folder.exists()


def test_a_brief_program_has_its_own_options_too():
    brief = kept.jit(lambda x: 2 * x, compiler_options={"xla_no_such_option": 1})
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_no_such_option"):
        brief(jnp.float32(1))


SOLVE = """
import sys
import jax, jax.numpy as jnp
from jax.sharding import Mesh
from vertiwm_jax import kept, xla

xla.keep_compiled()
mesh, ones = Mesh(jax.devices()[:1], ("one",)), jnp.ones((2, 2)) + jnp.eye(2)
solve = jax.jit(lambda x: jnp.linalg.inv(x) @ jnp.linalg.qr(x)[0])
print(kept.program("solve", mesh, lambda: print("compiled") or solve.lower(ones).compile())(ones))
"""


def test_a_program_that_calls_lapack_is_found(tmp_path):
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path)}

    def solve():
        command = [sys.executable, "-c", SOLVE]
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True)

    first, second = solve().stdout, solve().stdout
    assert first == "compiled\n" + second


TRAIN = """
import logging
from pathlib import Path
from vertiwm_jax import xla
from vertiwm_jax.rl import experiment

logging.basicConfig(level="INFO", force=True)
xla.keep_compiled()
print(experiment.run(experiment.load(Path("tiny.yaml")))[1])
"""


@pytest.mark.integration
def test_a_training_that_finds_its_program_learns_the_same(tmp_path):
    (tmp_path / "tiny.yaml").write_text(TINY)
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "kept")}

    def train():
        command = [sys.executable, "-c", TRAIN]
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, check=True, capture_output=True, text=True
        )
        return "compiling for" in done.stderr, tmp_path / done.stdout.split()[-1]

    (compiled, first), (again, second) = train(), train()
    assert compiled and not again
    policies = [dict(np.load(run / "policy" / "weights.npz")) for run in (first, second)]
    chex.assert_trees_all_equal(*policies)
    rewards = [[line["reward"] for line in runs.read_metrics(run)] for run in (first, second)]
    assert rewards[0] == rewards[1]
