"""Shared out to two devices, results are those of one, to rounding; `conftest.py` makes them."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.probes import ProbeParams, Staggered, Target

from vertiwm_jax import machine, parallel
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.dataset import WheelSignals
from vertiwm_jax.learning.fitting import Fit, FitConfig, FitInputs
from vertiwm_jax.learning.objectives import RolloutLoss
from vertiwm_jax.learning.problem import WindowConfig, WindowData, WindowProblem
from vertiwm_jax.mechanics.kinematic import KinematicBicycle, bicycle_of
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.rl.ppo import PPO, PPOConfig
from vertiwm_jax.rl.sac import SAC, SACConfig
from vertiwm_jax.training import Seeds

OPEN = Path(__file__).parents[2] / "data" / "open"


def devices_of(mesh, function, *args):
    """What a compiled function gives, with batches shared out on the mesh."""
    with jax.set_mesh(mesh):
        return jax.jit(function)(*parallel.place(mesh, args))


@pytest.fixture
def two():
    return parallel.mesh(16)


def test_a_mesh_has_as_many_devices_as_divide_the_batch(two):
    assert jax.device_count() == 2 == two.size
    assert parallel.mesh(17).size == parallel.mesh(4).size == parallel.mesh(1).size == 1


@pytest.mark.parametrize(("size", "at_a_time"), [(16, None), (16, 3), (7, None), (7, 2), (1, 5)])
def test_a_spread_function_gives_what_vmap_gives(two, size, at_a_time):
    def function(scale, x, y):
        return {"sum": scale * x.sum() + y, "first": x[0]}

    x, y = jax.random.normal(jax.random.key(0), (size, 3)), jnp.arange(size)
    expected = jax.vmap(function, (None, 0, 0))(2.0, x, y)
    spread = parallel.vmap(function, (None, 0, 0), at_a_time)
    chex.assert_trees_all_close(spread(2.0, x, y), expected, rtol=1e-6)
    chex.assert_trees_all_close(devices_of(two, spread, 2.0, x, y), expected, rtol=1e-6)


def test_arrays_without_elements_are_spread_too(two):
    """As obstacles on maps that have none."""

    def function(all_, each, x):
        return x + all_.shape[0] + each.shape[0] + all_.sum() + each.sum()

    args = jnp.zeros((3, 0)), jnp.zeros((8, 2, 0), jnp.int32), jnp.arange(8.0)
    given = devices_of(two, parallel.vmap(function, (None, 0, 0)), *args)
    chex.assert_trees_all_close(given, jnp.arange(8.0) + 5)


@pytest.mark.parametrize(("half", "faster"), [(0.55, True), (0.9, False), (1.6, False)])
def test_bfloat16_has_to_be_clearly_faster(half, faster, monkeypatch):
    monkeypatch.setattr(machine, "_seconds_of_matmul", lambda *_: [1.0, half])
    assert machine.multiplies_bfloat16.__wrapped__() is faster


def test_each_device_has_its_share_of_the_rows(two):
    with jax.set_mesh(two):
        program = jax.jit(parallel.vmap(jnp.sin, (0,), 4)).lower(jnp.zeros(64))
    # 32 rows on each device, in eight turns of four.
    assert "tensor<8x4xf32>" in program.as_text()


def test_what_is_shared_out_already_is_not_shared_out_again(two):
    inner = parallel.vmap(jnp.sin, (0,))
    x = jax.random.normal(jax.random.key(0), (8, 3))
    given = devices_of(two, parallel.vmap(inner, (0,)), x)
    chex.assert_trees_all_close(given, jnp.sin(x), rtol=1e-6)


def test_gradients_are_summed_over_devices(two):
    def loss(weight, x):
        return jnp.mean(parallel.vmap(lambda weight, x: (weight @ x) ** 2, (None, 0))(weight, x))

    weight, x = jnp.arange(3.0), jax.random.normal(jax.random.key(0), (12, 3))
    expected = jax.grad(lambda w: jnp.mean((x @ w) ** 2))(weight)
    chex.assert_trees_all_close(devices_of(two, jax.grad(loss), weight, x), expected, rtol=1e-5)


def test_results_of_what_is_shared_out_are_on_one_device():
    doubled = parallel.shared_out(jax.jit(parallel.vmap(lambda x: 2 * x, (0,))), 16)
    result = doubled(jnp.arange(16))
    assert result.devices() == {jax.devices()[0]} and jax.typeof(result).sharding.mesh.empty
    np.testing.assert_array_equal(result, 2 * np.arange(16))


@pytest.mark.parametrize("at_a_time", [3, 5, 10])
def test_turns_give_what_all_at_once_gives(at_a_time):
    traced = []

    @jax.jit
    def function(batch):
        traced.append(len(batch["a"]))
        return {"sum": batch["a"] + batch["b"][:, 0], "first": batch["b"][:, :1]}

    batch = {"a": jnp.arange(10), "b": jnp.arange(20).reshape(10, 2)}
    found = parallel.in_turns(function, batch, at_a_time)
    assert traced == [at_a_time]
    chex.assert_trees_all_equal(found, function(batch))


def with_three_cores(program: str) -> subprocess.CompletedProcess[str]:
    """What a new process that has so many cores makes of a program."""
    cores = "import os, sys; os.sched_getaffinity = lambda process: {0, 1, 2}\n"
    unset = {name: value for name, value in os.environ.items() if name != "JAX_NUM_CPU_DEVICES"}
    command = [sys.executable, "-c", cores + program]
    return subprocess.run(command, env=unset, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("before", "expected"),
    [
        ("from vertiwm_jax import cli; cli.prepare('ppo')", 3),
        ("sys.argv[0] = '-m'", 1),
        ("from vertiwm_jax import machine; machine.use_cores(); machine.use_cores()", 3),
    ],
)
def test_commands_use_all_cores_and_scripts_what_they_ask_for(before, expected):
    found = with_three_cores(
        f"{before}\nimport vertiwm_jax.rl.ppo, jax\nprint(jax.device_count())\n"
    )
    assert int(found.stdout) == expected


def test_to_import_the_package_changes_nothing():
    program = """
import gc
before = gc.get_threshold(), dict(os.environ)
import vertiwm_jax
assert "jax" not in sys.modules
assert (gc.get_threshold(), dict(os.environ)) == before
"""
    found = with_three_cores(program)
    assert found.returncode == 0, found.stderr


def test_to_ask_for_all_cores_too_late_is_an_error_that_says_what_to_do():
    program = "import vertiwm_jax.rl.ppo\nfrom vertiwm_jax import machine\nmachine.use_cores()\n"
    found = with_three_cores(program)
    assert found.returncode == 1
    assert "JAX has started with 1 CPU device(s) of 3. Call it before" in found.stderr
    assert "JAX_NUM_CPU_DEVICES=3" in found.stderr


PPO_CONFIG = PPOConfig(
    total_timesteps=512, num_envs=16, num_steps=16, minibatches=4, epochs=2, hidden=(8,)
)
SAC_CONFIG = SACConfig(
    total_timesteps=512,
    num_envs=16,
    num_steps=16,
    batch=32,
    buffer_size=512,
    learning_starts=64,
    hidden=(8,),
)
ALGORITHMS = {
    "ppo": PPO(Target(), PPO_CONFIG),
    "ppo, some cut off": PPO(Staggered(), PPO_CONFIG),
    "sac": SAC(Target(), SAC_CONFIG),
}


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize(("seeds", "apart"), [(1, 1), (2, 1), (2, 2)])
def test_training_on_two_devices_is_training_on_one(name, seeds, apart):
    algorithm = Seeds(ALGORITHMS[name], seeds)
    two = parallel.mesh(16, apart)
    assert dict(two.shape) == {"seeds": apart, "batch": 2 // apart}
    assert algorithm.algorithm.batch == 16
    params = ProbeParams(max_steps_in_episode=20)
    start = jax.jit(algorithm.init)(params, jax.random.key(0))

    def train(mesh):
        state = start
        for _ in range(2):
            state, metrics = devices_of(mesh, algorithm.iterate, params, state)
        return jax.device_get((jax.tree.map(random_bits, state), metrics))

    chex.assert_trees_all_close(train(two), train(parallel.mesh(1)), rtol=2e-4, atol=2e-5)


def random_bits(leaf):
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def test_fitting_on_two_devices_is_fitting_on_one(two):
    config = WindowConfig(batch=16, context=2, horizon=4, validation=9)
    drives, terrain = dataset.load_drives([OPEN / "rigid"], "validation")
    drives = jax.tree.map(lambda x: x[:1], replace(drives, wheels=WheelSignals()))
    model, params = KinematicBicycle(), bicycle_of(load_vehicle())
    data = WindowData.of(config, (drives, terrain), (drives, terrain))
    problem = WindowProblem(model, RolloutLoss(model), config)
    fit = Fit(problem, FitConfig(updates=4, updates_per_iteration=4, warm_up=1))
    assert problem.config.batch == 16
    inputs = FitInputs(jax.tree.map(jnp.asarray, params), data)
    start = fit.init(inputs, jax.random.key(0))

    def fitted(mesh):
        state, metrics = devices_of(mesh, fit.iterate, inputs, start)
        return jax.device_get((state.trained, state.best_error, metrics))

    chex.assert_trees_all_close(fitted(two), fitted(parallel.mesh(1)), rtol=1e-4)
