"""A window of pressed soil that goes with a vehicle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.terrain.ruts import CELL_METERS, CELLS, Ruts


def at(x: float, y: float) -> jax.Array:
    return jnp.array([x, y, 0.0])


def test_a_rut_is_found_in_its_cell_and_nowhere_else():
    ruts = Ruts.none(at(100.0, -7.0)).pressed(jnp.array([[101.23, -8.04]]), jnp.array([0.07]))
    points = jnp.array([[101.21, -8.09], [101.29, -8.01], [101.19, -8.04], [101.23, -7.99]])
    np.testing.assert_allclose(ruts.at(*points.T), [0.07, 0.07, 0.0, 0.0], atol=1e-7)


def test_the_deepest_pass_counts():
    place = jnp.array([[0.05, 0.05]] * 3)
    ruts = Ruts.none(at(0, 0)).pressed(place, jnp.array([0.02, 0.09, 0.05]))
    ruts = ruts.pressed(place[:1], jnp.array([0.03]))
    assert float(ruts.at(*place[0])) == pytest.approx(0.09)


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1), (0.6, -0.8)])
def test_what_leaves_the_window_is_forgotten(direction):
    """Also when the vehicle comes back."""
    ahead = np.array(direction)
    rut = jnp.asarray(np.array([0.05, 0.05]))
    ruts = Ruts.none(at(0, 0)).pressed(rut[None], jnp.array([0.1]))
    follow = jax.jit(lambda ruts, xy: ruts.followed(at(*xy)))
    for way, kept in ((np.arange(0, 15, 0.7), True), (np.arange(15, 24, 0.7), False)):
        for meters in way:
            ruts = follow(ruts, meters * ahead)
        assert (float(ruts.at(*rut)) > 0) == kept
    for meters in np.arange(24, 0, -0.7):
        ruts = follow(ruts, meters * ahead)
    assert float(jnp.max(ruts.depth)) == 0


def test_ground_at_the_far_end_is_not_taken_for_what_lies_a_window_away():
    side = CELLS * CELL_METERS
    ruts = Ruts.none(at(0, 0)).pressed(jnp.array([[3.05, 4.05]]), jnp.array([0.1]))
    away = jnp.array([[3.05 + side, 4.05], [3.05, 4.05 - side], [3.05, 4.05]])
    np.testing.assert_allclose(ruts.at(*away.T), [0, 0, 0.1], atol=1e-7)


def test_nothing_is_pressed_outside_the_window():
    """Where it would be taken for ground within."""
    beyond = jnp.array([[16.05, 0.05], [0.05, -16.05], [40.0, 40.0]])
    ruts = Ruts.none(at(0, 0)).pressed(beyond, jnp.full(3, 0.1))
    assert float(jnp.max(ruts.depth)) == 0


def test_vehicles_of_a_batch_have_ruts_of_their_own():
    places = jnp.array([[0.0, 0.0, 0.0], [50.0, 20.0, 0.0]])
    ruts = jax.vmap(Ruts.none)(places)
    ruts = jax.vmap(Ruts.pressed)(ruts, places[:, None, :2] + 0.05, jnp.array([[0.1], [0.2]]))
    points = places[:, :2] + 0.05
    found = jax.vmap(lambda own: own.at(*points.T))(ruts)
    np.testing.assert_allclose(found, [[0.1, 0], [0, 0.2]], atol=1e-7)


def test_ruts_have_a_gradient_to_their_depth():
    place = jnp.array([[0.05, 0.05]])

    @jax.grad
    def slope(depth):
        return Ruts.none(at(0, 0)).pressed(place, depth[None]).at(*place.T)[0]

    assert float(slope(jnp.float32(0.1))) == 1.0
