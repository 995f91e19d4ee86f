import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.rl.off_policy import Replay

ROW = {"a": jnp.zeros(2), "b": jnp.int32(0)}


def rows(first, number):
    count = jnp.arange(first, first + number, dtype=jnp.int32)
    return {"a": jnp.stack([count, -count], axis=-1).astype(jnp.float32), "b": count}


def test_the_newest_rows_replace_the_oldest():
    replay = Replay.create(ROW, capacity=6)
    assert int(replay.filled) == 0
    for first, oldest in ((0, 0), (2, 0), (4, 0), (6, 2)):
        replay = jax.jit(Replay.add)(replay, rows(first, 2))
        held = np.asarray(replay.rows["b"])[: int(replay.filled)]
        assert set(held.tolist()) == set(range(oldest, first + 2))
        np.testing.assert_array_equal(replay.rows["a"][: len(held), 1], -held)


def test_samples_are_even_over_what_is_held_and_keep_rows_together():
    replay = Replay.create(ROW, capacity=8).add(rows(1, 4))
    sample = replay.sample(jax.random.key(0), 8000)
    counts = np.bincount(np.asarray(sample["b"]), minlength=9)
    assert counts[0] == 0 and counts[5:].sum() == 0
    np.testing.assert_allclose(counts[1:5], 2000, rtol=0.1)
    np.testing.assert_array_equal(sample["a"][:, 0], sample["b"])


def test_a_number_of_rows_that_does_not_divide_the_capacity_is_refused():
    with pytest.raises(AssertionError):
        Replay.create(ROW, capacity=7).add(rows(0, 2))


def test_adding_compiles_once():
    add = jax.jit(chex.assert_max_traces(Replay.add, n=1))
    replay = Replay.create(ROW, capacity=4)
    for first in range(5):
        replay = add(replay, rows(2 * first, 2))
