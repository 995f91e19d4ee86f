"""The task on a map that only becomes known on the way."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env.worlds import bicycle_env, ground, hills, step_of_many, task

from vertiwm_jax.env.observation import LAYOUT, arcs_ahead
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.sensing import SensingConfig

KEY = jax.random.key(0)
REVEALED = NavigationConfig(sensing=SensingConfig(range=12.0))
TASK = task((-30.0, 0.0), (30.0, 0.0))
AHEAD = jnp.array([0.6, 0.0])


def drive(env, params, steps=90):
    """Observations and states of each step, `[T, ...]`."""

    @jax.jit
    def driven(params):
        def advance(state, _):
            observation, state, *_ = env.step_env(KEY, state, AHEAD, params)
            return state, (observation, state)

        return jax.lax.scan(advance, env.start(params, jnp.int32(0))[1], length=steps)[1]

    return driven(params)


def stepped(at):
    """Hills with a step of 2 m across the way, `at` m from the middle."""
    return ground(hills() + 2.0 * (np.arange(129) - 64 >= at).astype(np.float32))


@pytest.mark.integration
def test_what_was_not_seen_is_neither_observed_nor_missed():
    """A step in the ground is observed once it is in range, and changes nothing before."""
    env, params = bicycle_env(ground(hills()), TASK, REVEALED)
    other = replace(params, terrain=stepped(6.0))
    (seen, states), (found, others) = drive(env, params), drive(env, other)
    chex.assert_trees_all_equal(states.observed.known, others.observed.known)
    # Cells are 2 m wide, and seen by their middle.
    x = np.asarray(states.vehicle.position[:, 0])
    far, near = x < 6.0 - 12.0, x > 6.0 - 12.0 + 2.0
    assert near.sum() > 5 and far.sum() > 5
    np.testing.assert_array_equal(seen[far], found[far])
    assert (np.abs(seen - found).max(axis=1) > 0.1)[near].all()

    env, params = bicycle_env(ground(hills()), TASK)
    (seen, _), (found, _) = drive(env, params), drive(env, replace(params, terrain=stepped(6.0)))
    assert not np.allclose(seen[far], found[far])


def test_the_vehicle_follows_the_true_ground():
    (_, hidden), (_, known) = (
        drive(*bicycle_env(ground(hills()), TASK, config))
        for config in (REVEALED, NavigationConfig())
    )
    chex.assert_trees_all_close(hidden.vehicle, known.vehicle, rtol=1e-5, atol=1e-5)


@pytest.mark.integration
def test_sensors_that_see_everything_show_what_a_known_map_shows():
    everything = NavigationConfig(sensing=SensingConfig(range=200.0))
    rocks = [[9.0, 2.0, 4.0, 4.0, 2.0]]
    revealed, known = (
        np.array(drive(*bicycle_env(ground(hills(), rocks), TASK, config))[0])
        for config in (everything, NavigationConfig())
    )
    way = LAYOUT["route"].where
    assert np.abs(revealed[:, way] - known[:, way]).max() > 0.1  # no way is planned beforehand
    for seen in (revealed, known):
        seen[:, way] = 0.0
    np.testing.assert_allclose(revealed, known, atol=1e-5)


def test_a_known_map_has_no_belief():
    env, params = bicycle_env(ground(hills()), TASK)
    state = env.reset_env(KEY, params)[1]
    assert state.observed is None and params.observed_map(state).observed is None


def test_a_wall_is_seen_when_it_comes_into_range():
    rock = [[0.0, 0.0, 4.0, 4.0, 2.0]]
    env, params = bicycle_env(ground(obstacles=rock), TASK, REVEALED)
    seen, states = drive(env, params, 80)
    crown = np.asarray(jax.vmap(arcs_ahead)(seen)[1]).max(axis=(1, 2))
    gap = -np.asarray(states.vehicle.position[:, 0])
    assert (crown[gap > 14.0] < 1e-3).all() and (crown[(gap < 10.5) & (gap > 6)] > 1).all()
    assert TerminationReason(int(states.ending[-1])) == TerminationReason.COLLIDED
    # An episode that is over stays as it is.
    over = np.flatnonzero(np.asarray(states.ending) != TerminationReason.RUNNING)
    first, last = (jax.tree.map(lambda x, i=i: x[i], states.observed) for i in over[[0, -1]])
    chex.assert_trees_all_equal(first, last)


@pytest.mark.integration
def test_many_are_stepped_in_one_program_and_begin_anew_with_what_they_see_there():
    config = replace(REVEALED, horizon_seconds=0.5)
    terrain = ground(hills())
    env, params = bicycle_env(terrain, circle_tasks(terrain, radius=50.0), config)
    n = 6
    states = jax.vmap(env.reset, (0, None))(jax.random.split(KEY, n), params)[1]
    step = step_of_many(env, AHEAD)
    for i in range(1, 6):
        before = states
        observation, states, *_ = step(jax.random.key(i), states, params)
        grown = np.asarray(states.observed.known | before.observed.known == states.observed.known)
        assert grown.all() == (i < 5)
    first = set(map(bytes, np.asarray(params.starts.observed.known)))
    assert {bytes(known) for known in np.asarray(states.observed.known)} <= first
    assert set(map(bytes, np.asarray(observation))) <= set(
        map(bytes, np.asarray(params.start_observation))
    )


def test_what_does_not_go_together_is_refused():
    with pytest.raises(ValueError, match=r"sensing.range: expected inf with embeddings"):
        NavigationConfig(embeddings=True, sensing=SensingConfig(range=12.0))
    with pytest.raises(ValueError, match=r"sensing.missing: expected 0 with embeddings"):
        NavigationConfig(embeddings=True, sensing=SensingConfig(missing=0.1))
    coarse = NavigationConfig(sensing=SensingConfig(range=12.0, cells=8))
    with pytest.raises(ValueError, match=r"sensing.cells: expected at least 23"):
        bicycle_env(ground(hills()), TASK, coarse)


SENSING = {
    "missing": SensingConfig(missing=0.2),
    "noise": SensingConfig(height_noise=0.03),
    "displaced": SensingConfig(displaced=0.5),
}


def erroneous(name, tasks=TASK):
    return bicycle_env(ground(hills()), tasks, NavigationConfig(sensing=SENSING[name]))


def test_missing_cells_stay_missing():
    env, params = erroneous("missing")
    _, states = drive(env, params)
    known = np.asarray(states.observed.known)
    assert (known == known[0]).all()
    assert known[0].mean() == pytest.approx(0.8, abs=0.02)
    # Where a cell is missing, the plane through what is seen stands for it.
    state = jax.tree.map(lambda x: x[40], states)
    observed = params.observed_map(state)
    middles = (np.arange(64) + 0.5) * 2.0 - 64.0
    xy = jnp.asarray(np.stack(np.meshgrid(middles, -middles), axis=-1), jnp.float32)
    seen, true = (query.height(terrain, xy) for terrain in (observed, params.terrain))
    plane = observed.observed.plane
    assumed = plane[0] + xy @ plane[1:]
    np.testing.assert_allclose(seen[known[0]], true[known[0]], atol=1e-5)
    assert np.median(np.abs(seen - assumed)[~known[0]]) < 0.05


def test_heights_err_by_as_much_as_is_said_and_always_alike():
    env, params = erroneous("noise", circle_tasks(ground(hills()), radius=50.0))
    states = [env.start(params, jnp.int32(i))[1] for i in (0, 1)]
    vertices = jnp.stack(jnp.meshgrid(jnp.arange(-60.0, 61), jnp.arange(-60.0, 61)), axis=-1)
    true = query.height(params.terrain, vertices)
    first, again, other = (
        np.asarray(query.height(params.observed_map(state), vertices) - true)
        for state in (states[0], states[0], states[1])
    )
    np.testing.assert_array_equal(first, again)
    assert first.std() == pytest.approx(0.03, rel=0.02) and abs(first.mean()) < 1e-3
    # Neither neighbors nor episodes have anything in common.
    pairs = (first[1:], first[:-1]), (first[:, 1:], first[:, :-1]), (first, other)
    assert all(abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.03 for a, b in pairs)


@pytest.mark.integration
def test_a_displaced_map_shows_the_ground_beside():
    env, params = erroneous("displaced")
    known, _ = bicycle_env(ground(hills()), TASK)
    state = env.start(params, jnp.int32(0))[1]
    aside = np.asarray(state.observed.displaced)
    assert np.linalg.norm(aside) == pytest.approx(0.5, abs=1e-5)
    found = env.observe(KEY, state, None, params)
    position = state.vehicle.position.at[:2].add(aside)
    there = replace(state, vehicle=replace(state.vehicle, position=position), observed=None)
    np.testing.assert_allclose(found, known.observe(KEY, there, None, params), atol=1e-5)
    assert not np.allclose(
        found, known.observe(KEY, replace(state, observed=None), None, params), atol=1e-3
    )


def test_directions_of_displaced_maps_differ():
    _, params = erroneous("displaced", circle_tasks(ground(hills()), radius=50.0))
    aside = np.asarray(params.starts.observed.displaced)
    turns = np.sort(np.arctan2(aside[:, 1], aside[:, 0]))
    assert len(turns) == 10 and np.diff(turns).max() < 3 and len(np.unique(turns)) == 10
