"""What the golden numbers are of, each computed in one way: the test and `record` share it.

Everything starts from numbers that stand here, from keys, or from the recorded drives in
`data/open`. A group gives arrays, or lists of words, by name; what a group is named and what it
gives is fixed, how it comes by it is not.
"""

import csv
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import optax
from rl.probes import ProbeParams, Target

from vertiwm_jax import cli, runs
from vertiwm_jax import config as configuration
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.observation import IMAGE_SHAPE, OBSERVATION_SIZE
from vertiwm_jax.env.reward import RewardConfig
from vertiwm_jax.env.suites import Tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.learning import pipeline, stages
from vertiwm_jax.learning.experiment import FitConfig
from vertiwm_jax.learning.fitting import Fit, FitInputs, Problem, merge
from vertiwm_jax.learning.stages import Inputs
from vertiwm_jax.models import files
from vertiwm_jax.models.registry import Imagined, load_encoders, load_model
from vertiwm_jax.networks.specialist import ComputeDtype
from vertiwm_jax.perception.perceive import perceive
from vertiwm_jax.rl.ppo import PPO, PPOConfig
from vertiwm_jax.rl.sac import SAC, SACConfig
from vertiwm_jax.rl.td3 import TD3, TD3Config
from vertiwm_jax.runs import Run
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import BOUNDS

Numbers = dict[str, Any]

STORE = Path(__file__).with_name("golden.json")
OPEN_DRIVES = Path(__file__).parents[2] / "data" / "open"
# Eight vehicles about on the ground: x, y, z, roll, pitch, yaw, forward speed. They drive on snow,
# dirt, sand, concrete, snow, mud, snow and gravel, and some leave it. None stands still on soil:
# how wheels break away there depends on the last bits.
STARTS = np.array(
    [
        [-28.3, 21.6, 3.508, 0.017, 0.147, 0.3, 2.0],
        [-19.4, -10.7, 3.247, 0.135, -0.109, 1.2, 1.0],
        [-13.2, 27.1, 2.265, -0.117, 0.087, -2.4, 3.0],
        [3.7, -25.8, 4.181, 0.039, 0.162, 2.9, 2.5],
        [6.6, 5.3, 6.159, -0.009, -0.143, -0.7, 1.5],
        [20.9, -15.4, 4.979, 0.158, 0.109, 0.0, 3.5],
        [29.2, 12.5, 4.114, -0.164, -0.150, -1.6, 2.0],
        [26.3, -28.9, 4.265, 0.210, 0.006, 2.1, 3.0],
    ]
)
STEPS = 16
SPEEDS, REWARD = (0.0, 6.0), RewardConfig(stuck=300.0, failure=600.0)
KEPT = np.array([0, 3, 7, 15])
"""Steps whose states are kept, of `STEPS`."""
# As tests/integration/test_doors.py trains, where planning is a row more in the tests of policies.
TRAINING = """
ground: {train_worlds: 2, suites: [easy, obstacles], suite_worlds: 1, starts: 8, pairs: 2}
model: builtin
navigation:
  {horizon_seconds: 3, settle_steps: 2, speed_range: [0, 6], reward: {stuck: 300, failure: 600}}
simulator: {substeps: 1}
action_repeat: 2
ppo:
  {total_timesteps: 512, num_envs: 8, num_steps: 8, minibatches: 2, epochs: 1, hidden: [8],
   schedule: constant, discount: 0.99, initial_log_std: -0.5}
loop: {checkpoint_every: 2}
"""
PLANNING = "planning: {candidates: 2, decisions: 1, model: builtin}\n"
LEARNING = {
    "num_envs": 16,
    "num_steps": 16,
    "discount": 0.9,
    "learning_rate": 5e-3,
    "max_gradient_norm": 1.0,
    "hidden": (16,),
}
FIRST = {"initial_log_std": -0.5}
REPLAYING = {"updates": 2, "batch": 32, "buffer_size": 1024, "learning_starts": 128, "tau": 0.05}


def ground() -> TerrainMap:
    """128 m x 128 m of hills and bumps, all classes of ground in squares of 8 m, two boxes."""
    x, cell = np.arange(129.0) - 64, np.arange(16)
    y = x[:, None]
    bumps = 0.15 * np.sin(1.3 * x) * np.cos(1.1 * y)
    elevation = 4 + 1.5 * np.sin(x / 9) + np.cos(y / 7) + bumps
    boxes = [[-21.0, 24.0, 3.0, 2.0, 2.0], [12.0, 4.0, 2.0, 2.0, 1.5]]
    return TerrainMap.from_array(elevation, (cell + 3 * cell[:, None]) % 10, obstacles=boxes)


def starts() -> VehicleState:
    """Of all vehicles, leaves `[8, 3]`."""
    x = jnp.asarray(STARTS, jnp.float32)
    still = jnp.zeros((len(x), 3), jnp.float32)
    return VehicleState(x[:, :3], x[:, 3:6], still.at[:, 0].set(x[:, 6]), still)


def commands() -> Command:
    """Of all vehicles, leaves `[8, STEPS]`: faster than they are and then slower, in curves."""
    step, vehicle = np.arange(STEPS), np.arange(len(STARTS))[:, None]
    speed = np.where(step < STEPS / 2, 3.5, 1.0) + 0.2 * vehicle
    steering = 0.3 * np.sin(2 * np.pi * step / STEPS + vehicle)
    return Command(jnp.asarray(speed, jnp.float32), jnp.asarray(steering, jnp.float32))


def rollout(name: Imagined, dtype: ComputeDtype = "float32") -> Numbers:
    """Where all vehicles go, and what the model remembers."""
    dynamics, params = load_model(name, compute_dtype=dtype)

    @jax.jit
    def drive(params: Any, terrain: TerrainMap, start: VehicleState, commands: Command) -> Numbers:
        def advance(carry: tuple, command: Command) -> tuple[tuple, Numbers]:
            state, history = dynamics.step(params, terrain, carry[1], carry[0], command)
            return (state, history), {**vars(state), **_remembered(name, history)}

        history = dynamics.init(params, terrain, start)
        return jax.lax.scan(advance, (start, history), commands)[1]

    of_all = jax.vmap(drive, (None, None, 0, 0))
    found = of_all(params, ground(), starts(), commands())
    return {quantity: x[:, KEPT] for quantity, x in found.items()}


def _remembered(name: Imagined, history: Any) -> Numbers:
    """Of the gates and of the wheels."""
    found: Numbers = {}
    if name == "vertiwm":
        hidden = jnp.linalg.norm(history.hidden, axis=-1)
        gates = "coefficients", "disagreement", "spread"
        found |= {"hidden": hidden, **{gate: getattr(history, gate) for gate in gates}}
        history = history.nesam
    if name == "nesam":
        history = history.specialist
    if name in ("vertiwm", "nesam"):
        history = history.simulator
    if name in ("vertiwm", "nesam", "builtin"):
        found |= {"wheel_speed": history.wheel_speed, "sinkage": history.sinkage}
    return found


def sight() -> Numbers:
    """What encoders see at the starts, and which soil NeSAM takes it for."""
    terrain, weights = ground(), files.load(files.PRETRAINED)[1].encoders[0].soil
    encoders = (replace(load_encoders(), soil=weights),)
    (seen,) = jax.jit(jax.vmap(lambda state: perceive(encoders, terrain, state, True)))(starts())
    soil, latent = seen.soil, seen.latents
    return {
        "mean": latent.mean(axis=(1, 2)),
        "deviation": latent.std(axis=(1, 2)),
        "corners": latent[:, ::15, ::15, ::5],
        **{f"soil/{name}": getattr(soil, name) for name in BOUNDS},
    }


def environment() -> Numbers:
    """Five steps of four tasks as policies see them, the ground by encoders too."""
    dynamics, weights = load_model("bicycle")
    env = NavigationEnv(
        dynamics, NavigationConfig(speed_range=SPEEDS, reward=REWARD, embeddings=True)
    )
    xy, yaw = (jnp.asarray(STARTS[::2, columns], jnp.float32) for columns in ([0, 1], 5))
    pool = Tasks(jnp.zeros(len(xy), jnp.int32), xy, yaw, goal=-xy)
    params = env.make_params(weights, ground(), pool, encoders=load_encoders())
    states, rewards = params.starts, []
    step = jax.jit(jax.vmap(env.step_env, (None, 0, 0, None)))
    actions = jnp.array([[1.0, -0.5], [0.5, 0.2], [0.0, 0.0], [-0.5, 1.0]])
    for _ in range(5):
        observation, states, reward, *_ = step(jax.random.key(0), states, actions, params)
        rewards.append(reward)
    picture = observation[:, OBSERVATION_SIZE:].reshape(len(xy), -1, IMAGE_SHAPE[-1])
    return {
        "start": params.start_observation[:, :OBSERVATION_SIZE],
        "observation": observation[:, :OBSERVATION_SIZE],
        "embedding": picture[..., :-1].mean(axis=1),
        "reward": jnp.stack(rewards, axis=1),
    }


def procedural_worlds() -> Numbers:
    """One world of each kind of ground: heights at some vertices, and what else there is of it."""
    config = worlds.WorldConfig(("mid",), rocks=20, trees=2)
    terrain = worlds.generate(jax.random.split(jax.random.key(0), 3), config)
    classes = np.arange(len(terrain.class_names))
    return {
        "elevation": terrain.elevation[:, ::16, ::16],
        "deviation": jnp.std(terrain.elevation, axis=(1, 2)),
        "cells": jnp.sum(terrain.semantic[..., None] == classes, axis=(1, 2)),
        "friction": jnp.mean(terrain.friction, axis=(1, 2)),
        "obstacles": terrain.obstacles[:, ::4],
    }


def fit(name: str, **changes: Any) -> Numbers:
    """Loss and gradient of one batch of every stage, and the constants that are measured.

    name: of a file in `configs/`; changes: of its model. Gradients are told by the norms of their
    leaves, the smallest first, whatever the leaves are called.
    """
    found: Numbers = {}

    def stage(_: Run, name: str, inputs: Inputs, params: Any, data: Any, key: Any, *__: Any) -> Any:
        """Instead of `stages.fit`: a step along the gradient.

        Adam's first steps are as long for what is 0 but for rounding as for all else.
        """
        if not inputs.config.updates:
            return params
        given = FitInputs(*jax.device_put((params, data())))
        trained = Fit(inputs.problem, inputs.config).init(given, key).trained
        # Stages of several fits have the same problem, and compiling is all that they cost.
        program = jax.jit(partial(_descend, inputs.problem))
        program = _programs.setdefault(repr(inputs.problem), program)
        found[f"{name}/loss"], found[f"{name}/gradient"], moved = program(trained, given, key)
        return merge(params, moved)

    config = configuration.load(FitConfig, configuration.default_config(name))
    config = replace(
        config,
        model=replace(config.model, size="base", **changes),
        windows=replace(config.windows, batch=4, context=2, horizon=4),
        patches=replace(config.patches, batch=4),
    )
    start = files.load(files.PRETRAINED)[1] if config.start else None
    with tempfile.TemporaryDirectory() as folder, patch.object(stages, "fit", stage):
        for kind in pipeline.KINDS:
            for file in (Path(kind, f"{kind}_001.npz"), Path("maps", f"{kind}_001.npz")):
                Path(folder, file.parent).mkdir(exist_ok=True)
                Path(folder, file).symlink_to(OPEN_DRIVES / file)
        config = replace(config, data=(Path(folder),))
        params = pipeline.fit(config, Run(Path(folder), None), start)
    if start is None and "gate" in config.model.parts:
        constants = vars(params.nesam.normalization) | {
            "correction_scale": params.nesam.correction_scale,
            "response": params.nesam.response,
            "gate_mean": params.gate.mean,
            "gate_scale": params.gate.scale,
        }
        found |= {f"constants/{constant}": x for constant, x in constants.items()}
    return found


_programs: dict[str, Callable] = {}


def _descend(problem: Problem, trained: Any, given: FitInputs, key: jax.Array) -> tuple:
    """Loss, gradient, and what is trained after a step of fixed length."""

    def loss(trained: Any) -> jax.Array:
        return problem.loss(merge(given.params, trained), given.data, key)

    value, gradient = jax.value_and_grad(loss)(trained)
    rate = 0.3 / optax.tree.norm(gradient)
    return value, _norms(gradient), jax.tree.map(lambda x, dx: x - rate * dx, trained, gradient)


def _norms(tree: Any) -> jax.Array:
    """Of its leaves, the smallest first."""
    return jnp.sort(jnp.stack([jnp.linalg.norm(leaf) for leaf in jax.tree.leaves(tree)]))


def on_a_probe(name: str) -> Numbers:
    """What an algorithm has learned after three iterations of an environment of four steps."""
    env, params = Target(steps=4), ProbeParams()
    if name == "ppo":
        config = PPOConfig(**LEARNING, **FIRST, epochs=4, minibatches=2, schedule="constant")
        algorithm = PPO(env, config)
    elif name == "sac":
        algorithm = SAC(env, SACConfig(**LEARNING, **FIRST, **REPLAYING))
    else:
        algorithm = TD3(env, TD3Config(**LEARNING, **REPLAYING))
    state = jax.jit(algorithm.init)(params, jax.random.key(0))
    iterate = jax.jit(algorithm.iterate)
    for _ in range(3):
        state, metrics = iterate(params, state)
    if name == "ppo":
        weights = state.params
    else:
        weights = state.learner.actor, state.learner.averaged, state.learner.critics
    seen = jnp.linspace(-1, 1, 5)[:, None]
    return {
        "weights": _norms(weights),
        "actions": algorithm.policy(state)(seen),
        "values": algorithm.value(state)(seen),
        **{f"metrics/{metric}": x for metric, x in metrics.items()},
    }


def training(settings: str = TRAINING) -> Numbers:
    """What the command that trains a policy leaves: its first metrics, and all episodes of tests.

    Later metrics differ by half a percent between versions of JAX: vehicles that slide tell on last
    bits.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "tiny.yaml")
        file.write_text(settings)
        cli.main("ppo", ["--config", str(file), "--runs", folder])
        (run,) = Path(folder).glob("ppo-*")
        metrics = runs.read_metrics(run)[0]
        with (run / "episodes.csv").open() as lines:
            episodes = list(csv.DictReader(lines))
    timed = "wall_time", "timesteps_per_second"
    found = {f"metrics/{name}": x for name, x in metrics.items() if name not in timed}
    for column in episodes[0]:
        entries = [episode[column] for episode in episodes]
        words = column in ("suite", "policy", "ending")
        found[f"episodes/{column}"] = entries if words else np.array(entries, float)
    return found


GROUPS: dict[str, Callable[[], Numbers]] = {
    "worlds": procedural_worlds,
    "sight": sight,
    "environment": environment,
    "rollout/bicycle": partial(rollout, "bicycle"),
    "rollout/builtin": partial(rollout, "builtin"),
    "rollout/transformer/float32": partial(rollout, "transformer"),
    "rollout/transformer/bfloat16": partial(rollout, "transformer", "bfloat16"),
    "rollout/nesam/float32": partial(rollout, "nesam"),
    "rollout/nesam/bfloat16": partial(rollout, "nesam", "bfloat16"),
    "rollout/vertiwm/float32": partial(rollout, "vertiwm"),
    "rollout/vertiwm/bfloat16": partial(rollout, "vertiwm", "bfloat16"),
    "fit/fine_tune": partial(fit, "fine_tune", parts=("transformer", "nesam")),
    "fit/fit_chrono": partial(fit, "fit_chrono"),
    "fit/gates": partial(fit, "gates"),
    "fit/fit_paper": partial(fit, "fit_paper", parts=("transformer", "nesam")),
    "learning/ppo": partial(on_a_probe, "ppo"),
    "learning/sac": partial(on_a_probe, "sac"),
    "learning/td3": partial(on_a_probe, "td3"),
    "training": training,
    "planning": partial(training, TRAINING + PLANNING),
}
"""By the beginning of their names in the store."""
SLOW = ("fit/fit_chrono", "fit/gates", "fit/fit_paper", "planning")
"""Groups that take half a minute or more to compile."""


def compute(group: str) -> Numbers:
    """What a group gives as it is stored: lists, of words or of numbers with eight digits."""
    return {f"{group}/{name}": _listed(x) for name, x in GROUPS[group]().items()}


def stored(group: str) -> Numbers:
    """The same as it was written down."""
    numbers = json.loads(STORE.read_text()) if STORE.exists() else {}
    return {name: x for name, x in numbers.items() if name.startswith(f"{group}/")}


def _listed(value: Any) -> Any:
    if isinstance(value, list):
        return value
    return np.vectorize(lambda x: float(f"{x:.8g}"), otypes=[float])(value).tolist()
