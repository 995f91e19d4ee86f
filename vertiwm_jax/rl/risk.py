"""How likely a policy fails by its own driving within the next three seconds.

An ensemble of networks learns it from episodes of the policy, each with other first weights and
other batches (Lakshminarayanan et al., 2017). Every fifth world is kept from learning and says when
to stop: a network that goes on foretells what it has seen too well, and all else too boldly.
"""

import logging
from dataclasses import replace
from functools import partial
from typing import Any, Self, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from vertiwm_jax import machine
from vertiwm_jax.env.agent import Agent, Now, Policy
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import TaskParams
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.errors import UserError
from vertiwm_jax.networks.policy import Critic
from vertiwm_jax.precision import float32
from vertiwm_jax.rl.running_statistics import RunningStatistics
from vertiwm_jax.runs import Progress
from vertiwm_jax.state import STEP_SECONDS

SECONDS = 3.0
"""How far ahead failures are foretold."""
STANDING = 1.0
"""Seconds of stalling without a break that are a failure, as rollovers and collisions are."""
FAILURES = (TerminationReason.ROLLED_OVER, TerminationReason.COLLIDED)
_AHEAD, _STANDING = round(SECONDS / STEP_SECONDS), round(STANDING / STEP_SECONDS)
_MEMBERS, _UPDATES, _BATCH, _ROUND = 5, 1500, 1024, 50
_log = logging.getLogger(__name__)


@struct.dataclass
class Risk:
    """The probability that a policy fails within `SECONDS` of its own driving.

    network: static, its output is a logit; params: weights of the members of an ensemble, whose
        probabilities are averaged; observations: statistics that inputs are normalized by.
    """

    network: Critic = struct.field(pytree_node=False)
    params: Any
    observations: RunningStatistics

    @classmethod
    def untrained(cls, network: Critic, observation: jax.Array, key: jax.Array) -> Self:
        """With first weights, for observations like this one `[O]`."""
        keys = jax.random.split(key, _MEMBERS)
        params = jax.lax.map(lambda key: network.init(key, observation), keys)
        return cls(network, params, RunningStatistics.create(observation.shape))

    @float32
    def __call__(self, observation: jax.Array) -> jax.Array:
        """`[..., O]` observations to `[...]` probabilities."""
        seen = self.observations.normalize(observation)
        logits = jax.vmap(self.network.apply, (0, None))(self.params, seen)
        return jnp.mean(jax.nn.sigmoid(cast(jax.Array, logits)), axis=0)


@struct.dataclass
class Moments:
    """N moments of episodes in which a vehicle did not stand still.

    seen: `[N, O]` observations; failed: `[N]` bool, whether a failure came within `SECONDS`;
    world, task: `[N]` their numbers.
    """

    seen: np.ndarray
    failed: np.ndarray
    world: np.ndarray
    task: np.ndarray


def failing(
    ending: np.ndarray, steps: np.ndarray, stalled: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which moments count, `[P, T + 1]`, and whether a failure comes within `SECONDS`.

    A moment counts while an episode runs and its vehicle does not already stand still. What would
    have come after the end of an episode is no failure.

    Args:
        ending, steps: `[P]` of episodes, as `NavigationResult` has them.
        stalled: `[P, T + 1]` steps stalled without a break, from the start on.
    """
    time, end = np.arange(stalled.shape[1]), steps[:, None]
    standing = (stalled >= _STANDING) & (time <= end)
    fails = standing | ((time == end) & np.isin(ending, FAILURES)[:, None])
    never = stalled.shape[1] + _AHEAD
    next_one = np.minimum.accumulate(np.where(fails, time, never)[:, ::-1], axis=1)[:, ::-1]
    after = np.pad(next_one[:, 1:], [(0, 0), (0, 1)], constant_values=never)
    return (time < end) & ~standing, after - time <= _AHEAD


def watch(
    env: NavigationEnv, task: TaskParams, agent: Policy | Agent, key: jax.Array, every: int
) -> Moments:
    """Drives all tasks of a pool once; its moments, one in `every` steps."""
    # Observations of all would fill gigabytes.
    together = machine.together(cpu=128, accelerator=1024)

    def turn(first: int) -> Moments:
        # As many in each turn, so that one program drives all.
        rows = np.arange(first, first + together) % task.pool_size
        starts, seen = jax.tree.map(lambda x: x[rows], (task.starts, task.start_observation))
        some = replace(task, starts=starts, start_observation=seen)
        found = run_episodes(env, some, agent, jax.random.fold_in(key, first), _observed)
        new = min(together, task.pool_size - first)
        observation, stalled = found.kept
        ended = found.ending, found.steps, stalled, found.world
        ending, steps, stalled, world = (np.asarray(x)[:new] for x in ended)
        counts, failed = (x[:, ::every] for x in failing(ending, steps, stalled))
        number, time = np.nonzero(counts)
        # Thinned out where it is: most of it is not needed.
        seen = np.asarray(observation[:new, ::every])[number, time]
        progress.advance(new)
        return Moments(seen, failed[number, time], world[number], first + number)

    with Progress(task.pool_size, "tasks") as progress:
        turns = [turn(first) for first in range(0, task.pool_size, together)]
    return jax.tree.map(lambda *x: np.concatenate(x), *turns)


def _observed(agent: Agent, now: Now) -> tuple[jax.Array, jax.Array]:
    return now.observation, now.state.stalled


def learn(moments: Moments, network: Critic, key: jax.Array) -> Risk:
    """Learns from moments with observations `[N, O]` how likely failures are.

    Raises `UserError` where the vehicle never failed, or always, or drove fewer than five tasks.
    """
    failed = moments.failed
    group = np.unique(moments.world, return_inverse=True)[1]
    if group.max() < 4:  # So few worlds that tasks have to do.
        group = np.unique(moments.task, return_inverse=True)[1]
    kept = group % 5 == 4
    if failed.all() or not failed.any() or not kept.any():
        raise UserError(
            "expected moments of five tasks or more, before failures and others, found "
            f"{failed.sum()} failures in {len(failed)} moments of {len(np.unique(moments.task))} "
            "tasks; drive other tasks, or more of them"
        )
    shares = [f"{x.sum():,} ({moments.failed[x].mean():.2%})" for x in (~kept, kept)]
    _log.info("learning from %s moments (failures), stopping by %s ...", *shares)
    first, key = jax.random.split(key)
    risk = Risk.untrained(network, jnp.asarray(moments.seen[0]), first)
    statistics = risk.observations.update(jnp.asarray(moments.seen))
    given = [(jnp.asarray(moments.seen[x]), jnp.asarray(moments.failed[x])) for x in (~kept, kept)]
    risk, losses = _learn(replace(risk, observations=statistics), *given, key)
    _log.info("best after %d of %d updates", _ROUND * (1 + np.argmin(losses)), _UPDATES)
    return risk


@jax.jit
@float32
def _learn(
    risk: Risk,
    given: tuple[jax.Array, jax.Array],
    kept: tuple[jax.Array, jax.Array],
    key: jax.Array,
) -> tuple[Risk, jax.Array]:
    """The best of all rounds by the loss `[R]` on what is kept, which it also gives."""
    adam = optax.adamw(1e-3, weight_decay=0.1)

    def loss(params: Any, seen: jax.Array, failed: jax.Array) -> jax.Array:
        logits = risk.network.apply(params, risk.observations.normalize(seen))
        return jnp.mean(optax.sigmoid_binary_cross_entropy(logits, failed))

    def update(carry: Any, key: jax.Array) -> tuple[Any, None]:
        params, state = carry
        rows = jax.random.randint(key, (_MEMBERS, _BATCH), 0, len(given[0]))
        gradients = jax.vmap(jax.grad(loss))(params, *jax.tree.map(lambda x: x[rows], given))
        updates, state = adam.update(gradients, state, params)
        return (optax.apply_updates(params, updates), state), None

    def round(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        learning, best, least = carry
        learning, _ = jax.lax.scan(update, learning, jax.random.split(key, _ROUND))
        probability = replace(risk, params=learning[0])(kept[0])
        right = jnp.where(kept[1], probability, 1 - probability)
        found = -jnp.mean(jnp.log(jnp.maximum(right, 1e-6)))
        best = jax.tree.map(partial(jnp.where, found < least), learning[0], best)
        return (learning, best, jnp.minimum(found, least)), found

    first = (risk.params, adam.init(risk.params)), risk.params, jnp.float32(jnp.inf)
    (_, best, _), losses = jax.lax.scan(round, first, jax.random.split(key, _UPDATES // _ROUND))
    return replace(risk, params=best), losses
