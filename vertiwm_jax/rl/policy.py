"""A trained policy in a folder of its own, apart from the training that made it."""

import io
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax import atomic
from vertiwm_jax import config as configuration
from vertiwm_jax.checkpoints import CheckpointError, named_leaves
from vertiwm_jax.config import ConfigError, Count, Share
from vertiwm_jax.env import agent
from vertiwm_jax.env.controllers import baselines
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.errors import refusing
from vertiwm_jax.mechanics.vehicle import VehicleConfig
from vertiwm_jax.models.registry import ModelName
from vertiwm_jax.networks.policy import (
    Actor,
    Critic,
    Gaussian,
    TanhNormal,
    TanhNormalActor,
    twin_values,
)
from vertiwm_jax.precision import float32
from vertiwm_jax.rl.risk import Risk
from vertiwm_jax.rl.running_statistics import RunningStatistics

T = TypeVar("T")

FOLDER = "policy"
"""Name of the folder in that of a run."""
_RISK = "risk.npz"
_ACTIONS = 2
_STATISTICS = "mean", "variance", "count"
Base = Literal["look ahead", "straight to goal", "none"]


@struct.dataclass
class DeterministicPolicy:
    """What was learned as it is used: always the mean of what it would draw.

    actor: the network, static; params: its weights.
    observations: statistics that its observations are normalized by.
    base: a controller, static, whose actions it corrects; None if it acts by itself.
    risk: how likely it is to fail, where that was learned.
    """

    actor: Actor | TanhNormalActor = struct.field(pytree_node=False)
    params: Any
    observations: RunningStatistics
    base: agent.Policy | None = struct.field(pytree_node=False, default=None)
    risk: Risk | None = None

    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observations to `[..., A]` actions in [-1, 1]; the key is of the base."""
        seen = self.observations.normalize(observation)
        policy = cast(Gaussian | TanhNormal, self.actor.apply(self.params, seen))
        key = jax.random.key(0) if key is None else key
        return agent.corrected(self.base, observation, key, jnp.clip(policy.mean, -1.0, 1.0))


@struct.dataclass
class Value:
    """The return that a learned policy can expect, as far as it was learned.

    critic: the network, static; params: its weights. There are two sets of them, with an axis for
        both, unless PPO learned it: these judge actions, and the lower value counts.
    policy: whose return it is; scale: `[]` of the critic's output.
    """

    critic: Critic = struct.field(pytree_node=False)
    params: Any
    policy: DeterministicPolicy
    scale: jax.Array

    def __call__(self, observation: jax.Array) -> jax.Array:
        """`[..., O]` observations to `[...]` values, in units of reward."""
        seen = self.policy.observations.normalize(observation)
        if isinstance(self.policy.actor, Actor):
            return self.scale * cast(jax.Array, self.critic.apply(self.params, seen))
        values = twin_values(self.critic, self.params, seen, self.policy(observation))
        return self.scale * jnp.min(values, axis=0)


@configuration.settings
class PolicyConfig:
    """What `policy.yaml` says of a policy: how its networks are built, and what it is to drive."""

    algorithm: Literal["ppo", "sac", "td3"]
    """What it was trained by."""
    hidden: tuple[int, ...]
    """Widths of the layers of actor and critic."""
    initial_log_std: float | None
    """Of the actor, where it is random while it learns."""
    navigation: NavigationConfig
    """What the task is."""
    base: Base
    """The controller that it corrects."""
    action_repeat: Count
    """Steps of 0.1 s that its actions were held while it learned."""
    discount: Share
    """Of a decision, by which values were learned."""
    vehicle: VehicleConfig
    """What it drove."""
    model: ModelName
    """What moved the vehicle."""
    weights: Path | None = None
    """Folder of that model, if not the shipped one."""
    seeds: Count = 1
    """How many were trained side by side."""
    format: Literal[1] = 1
    """Of the folder."""

    @property
    def controller(self) -> agent.Policy | None:
        """What it corrects."""
        return baselines(self.navigation, self.vehicle.vehicle).get(self.base)

    @property
    def networks(self) -> tuple[Actor | TanhNormalActor, Critic]:
        """Actor and critic."""
        layout = self.navigation.observed.layout
        kind = Actor if self.algorithm == "ppo" else TanhNormalActor
        actor = kind(_ACTIONS, self.hidden, cast(Any, self.initial_log_std), layout)
        return actor, Critic(self.hidden, layout)

    @property
    def risk_network(self) -> Critic:
        """What learns how likely it fails."""
        return Critic(self.hidden, self.navigation.observed.layout)


@struct.dataclass
class Policy:
    """A trained driving policy; a pytree that can be called.

    learned: the actor with its weights; worth: the critic with its own.
    base: the controller that it corrects; config: of its folder.
    """

    learned: DeterministicPolicy
    worth: Value
    base: agent.Policy | None = struct.field(pytree_node=False)
    config: PolicyConfig = struct.field(pytree_node=False)

    @property
    def task(self) -> NavigationConfig:
        """What the task is that it was trained for."""
        return self.config.navigation

    @property
    def acting(self) -> DeterministicPolicy:
        """What drives: the controller as corrected, or the actor alone."""
        return replace(self.learned, base=self.base)

    def on(self, vehicle: VehicleConfig) -> Self:
        """The same policy with a controller of another vehicle."""
        config = replace(self.config, vehicle=vehicle)
        return replace(self, config=config, base=config.controller)

    @float32
    def __call__(self, observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """`[..., O]` observations to `[..., 2]` actions in [-1, 1]; no key is needed."""
        return self.acting(observation, key)

    @float32
    def value(self, observation: jax.Array) -> jax.Array:
        """`[..., O]` observations to `[...]` returns that it expects, in units of reward."""
        return self.worth(observation)

    @property
    def risk(self) -> Risk | None:
        """`[..., O]` observations to `[...]` probabilities that it rolls over, collides or stands
        still within 3 s; None before `vertiwm evaluate risk` has learned them."""
        return self.learned.risk


def save(folder: Path, config: PolicyConfig, value: Value) -> None:
    """Writes the folder of a policy, the one that `value` is of; leaves have an axis of seeds.

    `WriteError` where that is not possible.
    """
    folder.mkdir(exist_ok=True)
    observations = value.policy.observations
    arrays = {"actor": value.policy.params, "critic": value.params, "return_scale": value.scale}
    arrays |= {f"observation_{name}": getattr(observations, name) for name in _STATISTICS}
    # A risk would be that of other weights.
    (folder / _RISK).unlink(missing_ok=True)
    atomic.write(folder / "policy.yaml", configuration.dump(config))
    _write(folder / "weights.npz", arrays)


def save_risks(folder: Path, risks: Sequence[Risk]) -> None:
    """Writes how likely the policies of a run, or of its folder `policy`, fail: one of each seed.

    `WriteError` where that is not possible.
    """
    _write(_place(folder) / _RISK, jax.tree.map(lambda *x: np.stack(x), *risks))


@float32
def load_policy(folder: str | Path, seed: int = 0) -> Policy:
    """Loads a trained policy.

    Args:
        folder: of a run that trained it, or its folder `policy` alone.
        seed: which of those that were trained side by side.

    Returns:
        The policy: call it with observations `[..., O]` for actions `[..., 2]` in [-1, 1].

    Raises:
        CheckpointError: there is no policy in the folder, or its files do not fit each other.
        ConfigError: there is no such seed, or `policy.yaml` is malformed.
    """
    folder = Path(folder)
    place = _place(folder)
    file = place / "weights.npz"
    if not file.is_file():
        raise CheckpointError(f"{folder}: expected the folder of a trained policy, found none")
    config = configuration.load(PolicyConfig, place / "policy.yaml")
    if not 0 <= seed < config.seeds:
        raise ConfigError(f"{folder}: seed: expected 0 to {config.seeds - 1}, found {seed}")
    actor, critic = config.networks
    # Policies of other versions of this package may have seen something else.
    seen = jax.ShapeDtypeStruct((config.navigation.observed.size,), jnp.float32)
    weights = _read(file, jax.eval_shape(partial(_untrained, actor, critic), seen), seed)
    observations = RunningStatistics(*(weights[f"observation_{name}"] for name in _STATISTICS))
    risk = None
    if (place / _RISK).is_file():
        like = jax.eval_shape(partial(Risk.untrained, config.risk_network), seen, jax.random.key(0))
        risk = _read(place / _RISK, like, seed)
    learned = DeterministicPolicy(actor, weights["actor"], observations, risk=risk)
    value = Value(critic, weights["critic"], learned, weights["return_scale"])
    return Policy(learned, value, config.controller, config)


def _place(folder: Path) -> Path:
    """The folder of the policy, given that or the folder of its run."""
    inside = folder / FOLDER
    return inside if inside.is_dir() else folder


def _write(file: Path, arrays: Any) -> None:
    stream = io.BytesIO()
    np.savez(stream, **named_leaves(jax.device_get(arrays)))
    atomic.write(file, stream.getvalue())


def _read(file: Path, like: T, seed: int) -> T:
    """The arrays of one seed; `CheckpointError` unless they have the shapes of `like`."""
    refused = refusing(lambda found: CheckpointError(f"{file}: cannot read weights: {found}"))
    with refused, np.load(file, allow_pickle=False) as stored:
        arrays = {name: jnp.asarray(stored[name][seed]) for name in stored.files}
    names = named_leaves(like)
    for name, leaf in names.items():
        found = arrays[name].shape if name in arrays else "none"
        if found != leaf.shape:
            raise CheckpointError(
                f"{file}: {name}: expected shape {leaf.shape} as policy.yaml says, found {found}"
            )
    return jax.tree.unflatten(jax.tree.structure(like), [arrays[name] for name in names])


def _untrained(
    actor: Actor | TanhNormalActor, critic: Critic, observation: jax.Array
) -> dict[str, Any]:
    """All that `save` keeps, for observations of this shape."""
    key = jax.random.key(0)
    if isinstance(actor, Actor):
        critics = critic.init(key, observation)
    else:
        twins = jax.vmap(critic.init, (0, None, None))
        critics = twins(jax.random.split(key), observation, jnp.zeros(_ACTIONS))
    statistics = RunningStatistics.create(observation.shape)
    kept = {f"observation_{name}": getattr(statistics, name) for name in _STATISTICS}
    kept |= {"actor": actor.init(key, observation), "critic": critics}
    return kept | {"return_scale": jnp.float32(1)}
