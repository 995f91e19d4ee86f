"""Exported policies of every kind compute what the trained ones do, whatever runs them."""

import math
import subprocess
import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from doors import door, exportable, refusal, untrained
from env.worlds import SNOW, bicycle_env, hills, task
from flax import struct

from vertiwm_jax import atomic
from vertiwm_jax import config as configuration
from vertiwm_jax.deploy import export, onnx_graph, run_policy, stablehlo
from vertiwm_jax.env import observation, route
from vertiwm_jax.env.controllers import LookAhead
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.observation import OBSERVATION_LIMIT, OBSERVATION_SIZE
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.models.registry import load_encoders
from vertiwm_jax.networks.policy import Actor, TanhNormalActor
from vertiwm_jax.perception.perceive import embed
from vertiwm_jax.rl.experiment import SACTraining
from vertiwm_jax.rl.policy import DeterministicPolicy
from vertiwm_jax.rl.running_statistics import RunningStatistics
from vertiwm_jax.state import VehicleState
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.sensing import SensingConfig

CONFIG = NavigationConfig(speed_range=(-1.0, 5.0))
SIGHTED = replace(CONFIG, embeddings=True)
KINDS = {
    "ppo": (CONFIG, partial(Actor, 2, (8, 6, 5), -0.5)),
    "sac": (CONFIG, partial(TanhNormalActor, 2, (8, 6), -0.5)),
    "td3": (CONFIG, partial(TanhNormalActor, 2, (8,), None)),
    "embeddings": (SIGHTED, partial(Actor, 2, (8, 6), -0.5)),
    "no arcs": (replace(SIGHTED, arcs=False), partial(Actor, 2, (8, 6), -0.5)),
}
TINY = """
ground: {train_worlds: 2, suites: [easy], suite_worlds: 1, starts: 8, pairs: 1}
simulator: {substeps: 1}
model: builtin
navigation: {settle_steps: 1}
action_repeat: 3
loop: {seeds: 2}
sac:
  {total_timesteps: 192, num_envs: 8, num_steps: 8, batch: 8, buffer_size: 64, learning_starts: 64,
  hidden: [8]}
"""


def policy_of(kind, base):
    """A policy of random weights, whose actions are not all at their limits."""
    task, make = KINDS[kind]
    rng, actor, size = np.random.default_rng(0), make(task.observed.layout), task.observed.size
    shapes = jax.eval_shape(actor.init, jax.random.key(0), jnp.zeros(size))

    def drawn(leaf):
        return jnp.float32(rng.normal(0, 1 / np.sqrt(leaf.shape[0]), leaf.shape))

    mean, variance = jnp.float32(rng.uniform(size=(2, size)))
    statistics = RunningStatistics(mean, variance, jnp.float32(9))
    learned = DeterministicPolicy(actor, jax.tree.map(drawn, shapes), statistics)
    return exportable(learned, base, task)


def observations(size=OBSERVATION_SIZE):
    """`[B, size]` 64 usual ones, any within the limit, and its corners; goals all about."""
    rng = np.random.default_rng(0)
    usual = rng.normal(0, 0.5, (64, size))
    limit = OBSERVATION_LIMIT
    anything = rng.uniform(-limit, limit, (32, size))
    corners = rng.choice([-limit, 0.0, limit], (32, size))
    same = np.full((3, size), [[-limit], [0.0], [limit]])
    seen = np.concatenate([usual, anything, corners, same])
    bearing = np.linspace(-np.pi, np.pi, len(seen))
    seen[:64, 9], seen[:64, 10] = np.cos(bearing[:64]), np.sin(bearing[:64])
    around = [[1, 0], [-1, 0], [0, 1], [0, -1], [0, 0], [-1, 1e-7], [-1, -1e-7]]
    seen[-len(around) :, 9:11] = around
    return seen.astype(np.float32)


def in_onnx(model, seen):
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return session.run(["action"], {"observation": seen})[0]


def written(policy, folder):
    """The files of a policy, as on a robot, and the policy in NumPy."""
    made = export.files(policy)
    for name, data in made.items():
        atomic.write(folder / name, data)
    return made, run_policy.load(folder)


@jax.jit
def act(policy, seen):
    """As `run_episodes` asks a policy, weights as arguments."""
    return policy(seen, jax.random.key(1))


@pytest.mark.parametrize(
    ("kind", "base"),
    [(kind, "look ahead") for kind, (task, _) in KINDS.items() if task.arcs]
    + [("ppo", "straight to goal"), ("sac", "none"), ("no arcs", "none")],
)
def test_all_forms_of_a_policy_agree(kind, base, tmp_path):
    policy, seen = policy_of(kind, base), observations(KINDS[kind][0].observed.size)
    made, in_numpy = written(policy, tmp_path)
    in_stablehlo = jax.export.deserialize(bytearray(made["policy.stablehlo"])).call
    expected = np.asarray(act(policy, seen))
    assert np.ptp(expected, axis=0).min() > 0.3
    # Near the limits costs of arcs are hundreds, which float32 rounds before they are raised.
    tolerance = np.where(np.arange(len(seen)) < 64, 1e-5, 2e-4)[:, None]
    for form in (in_stablehlo, in_numpy, lambda seen: in_onnx(made["policy.onnx"], seen)):
        for some in (slice(None), slice(5, 6)):
            found = np.asarray(form(seen[some]))
            assert found.dtype == np.float32
            assert np.all(np.abs(found - expected[some]) <= tolerance[some])
    np.testing.assert_allclose(in_numpy(seen[5]), expected[5], atol=1e-5)
    command = load_vehicle().command(jnp.asarray(expected), CONFIG.speed_range)
    speed, steering = in_numpy.command(expected)
    np.testing.assert_allclose(speed, command.speed, atol=1e-6)
    np.testing.assert_allclose(steering, command.steering, atol=1e-6)
    # On the robot there is nothing but NumPy.
    script = "import sys, run_policy; run_policy.load('.'); print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True)
    loaded = found.stdout.decode().split()
    assert "numpy" in loaded and not {"jax", "vertiwm_jax", "onnx"} & set(loaded)


def test_observations_that_are_none_are_named(tmp_path):
    _, in_numpy = written(policy_of("ppo", "none"), tmp_path)
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 477\], found \(7,\)"):
        in_numpy(np.zeros(7))
    with pytest.raises(ValueError, match="expected finite numbers"):
        in_numpy(np.full(OBSERVATION_SIZE, np.nan))


@struct.dataclass
class Robot:
    """A policy that runs outside JAX."""

    policy: run_policy.Policy = struct.field(pytree_node=False)

    def __hash__(self):
        return id(self)

    def __call__(self, observation, key):
        answer = jax.ShapeDtypeStruct((2,), jnp.float32)
        return jax.pure_callback(
            lambda seen: self.policy(seen), answer, observation, vmap_method="expand_dims"
        )


def test_the_robot_drives_as_the_test_does(tmp_path):
    policy = policy_of("ppo", "look ahead")
    terrain = TerrainMap.from_array(hills(), np.full((16, 16), SNOW))
    config = NavigationConfig(speed_range=CONFIG.speed_range, horizon_seconds=4.0)
    env, params = bicycle_env(terrain, task((-20.0, 0.0), (20.0, 5.0)), config)
    key = jax.random.key(0)
    expected = run_episodes(env, params, policy, key)
    found = run_episodes(env, params, Robot(written(policy, tmp_path)[1]), key)
    assert expected.driven[0] > 3
    np.testing.assert_allclose(found.position, expected.position, atol=1e-3)


@pytest.mark.parametrize(
    ("size", "config"),
    [(129, CONFIG), (41, CONFIG), (129, SIGHTED), (129, KINDS["no arcs"][0])],
    ids=["arcs", "small", "embeddings", "no arcs"],
)
def test_the_observation_of_map_arrays(size, config):
    semantic = np.full((16, 16), SNOW)
    semantic[:, 8:] = 0
    boxes = np.array([[18, 4, 2, 3, 1], [0, 0, 0, 0, 0]], np.float32)
    terrain = TerrainMap.from_array(hills(size), semantic, obstacles=boxes)
    arrays = (terrain.elevation, terrain.semantic, terrain.friction, terrain.obstacles)
    state = VehicleState.from_vector(jnp.array([15, 1, 2, 0.1, -0.2, 0.7, 3, 0, 0, 0, 0, 0.1]))
    goal, action = jnp.array([20.0, 5.0, 1.0]), jnp.array([0.3, -0.4])
    waiting = jnp.array([1.5, 0.0])
    encoders = load_encoders() if config.embeddings else None
    observe, find_way, find_none = (
        jax.export.deserialize(bytearray(data)).call
        for data in (
            stablehlo.observe(config, load_vehicle(), encoders),
            stablehlo.route(replace(config, arcs=True), load_vehicle()),
            stablehlo.route(NavigationConfig(sensing=SensingConfig(range=12.0)), load_vehicle()),
        )
    )
    arrays = (*(x[0] for x in arrays), terrain.origin, terrain.resolution)
    worlds = jnp.zeros(1, jnp.int32)
    routes = route.plan(config.route, terrain, load_vehicle(), worlds, goal[None, :2])
    way = find_way(*arrays, goal)
    np.testing.assert_allclose(way, routes.cost[0], rtol=1e-5)
    straight = route.straight(config.route, terrain, goal[None, :2])
    np.testing.assert_allclose(find_none(*arrays, goal), straight.cost[0], rtol=1e-6)
    assert (way >= straight.cost[0] - 1e-3).all() and (way > 1.5 * straight.cost[0]).any()
    latents = jax.jit(embed)(encoders, terrain, state) if encoders else None
    expected = jax.jit(observation.observe, static_argnums=0)(
        config.observed, terrain, load_vehicle(), state, goal, routes, action, waiting, latents
    )
    assert expected.shape == (config.observed.size,)
    if config.arcs:
        assert 0 < (observation.arcs_ahead(expected)[1] == 7.5).sum() < 72
    if encoders:
        assert float(jnp.std(expected[-math.prod(observation.IMAGE_SHAPE) :])) > 0.1
    found = observe(*arrays, way, state.vector, goal, action, waiting)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.fixture(scope="module")
def run_and_policy(tmp_path_factory):
    """A run of two seeds with random weights, and the policy of the second."""
    run = tmp_path_factory.mktemp("run")
    (run / "config.yaml").write_text(TINY)
    policies = untrained(SACTraining, run)
    config = configuration.load(SACTraining, run / "config.yaml")
    return run, replace(policies[1], base=LookAhead(config.navigation))


def test_a_run_is_exported_as_it_is_evaluated(run_and_policy, tmp_path, capsys):
    run, policy = run_and_policy
    robot = tmp_path / "robot"
    door("export")([str(run), "--seed", "1", "--output", str(robot)])
    assert str(robot) in capsys.readouterr().out
    assert {path.name for path in robot.iterdir()} == {
        "policy.json", "policy.npz", "policy.onnx", "policy.stablehlo", "route.stablehlo",
        "observe.stablehlo", "run_policy.py",
    }  # fmt: skip
    in_numpy, seen = run_policy.load(robot), observations()
    np.testing.assert_allclose(in_numpy(seen[:64]), act(policy, seen[:64]), atol=1e-5)
    assert in_numpy.about["held_while_learning"] == 3
    assert in_numpy.about["action"]["standing"] == [-1.0, 0.0]
    message = refusal(door("export"), run, "--output", robot)
    assert "robot: expected no such folder yet, found one" in message


def test_what_cannot_be_exported_is_named_and_leaves_nothing(run_and_policy, tmp_path, monkeypatch):
    run, _ = run_and_policy
    none = "none: expected the folder of a trained policy, found none"
    assert none in refusal(door("export"), tmp_path / "none")
    assert not (tmp_path / "none").exists()
    assert "seed: expected 0 to 1, found 2" in refusal(door("export"), run, "--seed", 2)
    assert "expected the folder of a trained policy" in refusal(door("export"), tmp_path)
    assert not list(tmp_path.iterdir())
    monkeypatch.delitem(sys.modules, "vertiwm_jax.deploy.onnx_graph")
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert 'pip install "vertiwm-jax[export]"' in refusal(door("export"), run)
    assert {path.name for path in run.iterdir()} == {"config.yaml", "policy"}


@pytest.mark.parametrize("function", [np.sin, np.sort])
def test_what_cannot_be_recorded_is_refused(function):
    with pytest.raises(TypeError):
        onnx_graph.record(function, 3, 3)
