from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import bicycle_env, ground, hills

from vertiwm_jax.env.controllers import StraightToGoal
from vertiwm_jax.env.episodes import run_episodes
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason as Reason
from vertiwm_jax.errors import UserError
from vertiwm_jax.networks.policy import Critic
from vertiwm_jax.rl import risk
from vertiwm_jax.rl.risk import Moments, failing, learn, watch

LENGTH = 100
CONFIG = NavigationConfig(horizon_seconds=6.0)


def moments(ending: Reason, steps: int, stalled: dict[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """What `failing` says of one episode, whose stalls have a last step and a length."""
    counted = np.zeros((1, LENGTH + 1), int)
    for last, length in stalled.items():
        counted[0, last - length + 1 : last + 1] = 1 + np.arange(length)
    found = failing(np.array([ending]), np.array([steps]), counted)
    return found[0][0], found[1][0]


@pytest.mark.parametrize("ending", [Reason.ROLLED_OVER, Reason.COLLIDED])
def test_failures_are_foretold_for_three_seconds(ending):
    counts, failed = moments(ending, 50, {})
    assert np.flatnonzero(counts).tolist() == list(range(50))
    assert np.flatnonzero(failed & counts).tolist() == list(range(20, 50))


@pytest.mark.parametrize("ending", [Reason.GOAL, Reason.TIMED_OUT, Reason.OFF_MAP])
def test_no_other_end_is_a_failure(ending):
    counts, failed = moments(ending, 50, {49: 9})  # It stalls for less than a second.
    assert counts.sum() == 50 and not failed[counts].any()


def test_standing_still_is_a_failure_once():
    # It stands still from step 40 on, when it has stalled for a second, to step 60.
    counts, failed = moments(Reason.GOAL, 90, {60: 30})
    assert np.flatnonzero(~counts).tolist() == [*range(40, 61), *range(90, LENGTH + 1)]
    assert np.flatnonzero(failed & counts).tolist() == list(range(10, 40))


def test_stuck_vehicles_stood_still_before_their_end():
    stalled = np.minimum(np.arange(LENGTH + 1), 50)[None]
    counts, failed = failing(np.array([Reason.STUCK]), np.array([50]), stalled)
    assert np.flatnonzero(counts[0]).tolist() == list(range(10)) and failed[counts].all()


@pytest.mark.integration
def test_every_task_is_watched_once(monkeypatch):
    monkeypatch.setattr(risk.machine, "together", lambda cpu, accelerator: 4)
    env, task = bicycle_env(ground(hills()), circle_tasks(ground(), 26.0, 3), CONFIG)
    policy, key = StraightToGoal(CONFIG), jax.random.key(0)
    episodes = run_episodes(env, task, policy, key)
    found = watch(env, task, policy, key, every=1)
    # All of them start from rest, but none stands still for a second.
    assert np.bincount(found.task).tolist() == np.asarray(episodes.steps).tolist()
    assert found.seen.shape == (len(found.task), env.config.observed.size)
    first = found.seen[np.searchsorted(found.task, np.arange(3))]
    np.testing.assert_array_equal(first, task.start_observation)
    fewer = watch(env, task, policy, key, every=7)
    assert np.bincount(fewer.task).tolist() == [-(-n // 7) for n in np.asarray(episodes.steps)]


def drawn(number: int, seed: int) -> tuple[Moments, np.ndarray]:
    """Moments of ten worlds, and the probabilities by which they fail."""
    rng = np.random.default_rng(seed)
    seen = rng.normal(size=(number, 4)).astype(np.float32)
    probability = 1 / (1 + np.exp(3 - 2 * seen[:, 0]))
    failed = rng.uniform(size=number) < probability
    return Moments(seen, failed, np.arange(number) % 10, np.arange(number)), probability


@pytest.mark.integration
def test_probabilities_are_learned_as_they_are():
    learned = learn(drawn(20_000, 0)[0], Critic((16,)), jax.random.key(0))
    moments, probability = drawn(20_000, 1)
    found = np.asarray(learned(moments.seen))
    assert found.shape == probability.shape and found.min() >= 0 and found.max() <= 1
    for low, high in ((0.01, 0.03), (0.03, 0.1), (0.1, 0.3), (0.3, 1.0)):
        part = (found >= low) & (found < high)
        assert found[part].mean() == pytest.approx(probability[part].mean(), rel=0.3)
    assert np.sqrt(np.mean((found - probability) ** 2)) < 0.03


@pytest.mark.integration
def test_chance_is_not_learned_by_heart():
    few, _ = drawn(500, 0)
    chance = np.random.default_rng(1).permutation(few.failed)
    learned = learn(replace(few, failed=chance), Critic((64, 64)), jax.random.key(0))
    new = np.asarray(learned(jnp.asarray(drawn(5000, 2)[0].seen)))
    assert np.median(new) == pytest.approx(chance.mean(), rel=0.5) and new.std() < 0.1


@pytest.mark.parametrize("failed", [True, False])
def test_what_never_varies_is_refused(failed):
    few = drawn(100, 0)[0]
    with pytest.raises(UserError, match=f"found {100 * failed} failures in 100 moments"):
        learn(replace(few, failed=np.full(100, failed)), Critic((8,)), jax.random.key(0))


def test_fewer_than_five_tasks_are_refused():
    few = drawn(100, 0)[0]
    with pytest.raises(UserError, match="in 100 moments of 4 tasks"):
        learn(replace(few, world=few.world % 3, task=few.task % 4), Critic((8,)), jax.random.key(0))
