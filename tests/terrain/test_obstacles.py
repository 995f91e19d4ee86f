import jax
import jax.numpy as jnp
import numpy as np

from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import obstacles
from vertiwm_jax.terrain.map import TerrainMap

BOXES = np.array(
    [[3, 4, 4, 2, 3.8], [4, 4, 1, 6, 5], [-6, -3, 0.5, 0.5, 1], [0, 0, 0, 0, 0]], np.float32
)


def build(boxes):
    return TerrainMap.from_array(np.zeros((33, 33)), np.zeros((4, 4), int), obstacles=boxes)


def corners(x, y, yaw, length, width):
    along = np.array([np.cos(yaw), np.sin(yaw)]) * length / 2
    across = np.array([-np.sin(yaw), np.cos(yaw)]) * width / 2
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return np.array([[x, y] + a * along + b * across for a, b in signs])


def clipped_area(polygon, box):
    """Area of a convex polygon within a box (Sutherland and Hodgman, shoelace)."""
    for axis in (0, 1):
        for sign in (1, -1):
            limit = sign * box[axis] + box[2 + axis] / 2
            inside, points = sign * polygon[:, axis] <= limit, []
            for k in range(len(polygon)):
                a, b = polygon[k - 1], polygon[k]
                if inside[k - 1] != inside[k]:
                    t = (sign * limit - a[axis]) / (b[axis] - a[axis])
                    points.append(a + t * (b - a))
                if inside[k]:
                    points.append(b)
            polygon = np.array(points).reshape(-1, 2)
    x, y = polygon.T
    return abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2


def test_collides_where_the_areas_overlap():
    rng = np.random.default_rng(0)
    xy, yaw = rng.uniform(-8, 8, (400, 2)), rng.uniform(-4, 4, 400)
    found = obstacles.collides(build(BOXES), jnp.array(xy), jnp.array(yaw), 4.6, 2.1)
    area = np.array(
        [
            max(clipped_area(corners(*p, a, 4.6, 2.1), box) for box in BOXES[:3])
            for p, a in zip(xy, yaw, strict=True)
        ]
    )
    assert 50 < (area > 0).sum() < 350
    np.testing.assert_array_equal(found, area > 0)


def test_no_obstacles_no_collision():
    terrain = build(np.zeros((0, 5)))
    xy = jnp.zeros((2, 3, 2))
    assert not obstacles.collides(terrain, xy, jnp.zeros((2, 3)), 4, 2).any()


def test_a_nan_pose_touches_nothing():
    terrain = build(np.array([[0, 0, 30, 30, 1]]))
    poses = jnp.array([[np.nan, 0], [0, 0], [0, 0]]), jnp.array([0, np.nan, 0])
    assert obstacles.collides(terrain, *poses, 4, 2).tolist() == [False, False, True]


def test_unused_rows_are_no_obstacles_and_worlds_are_apart():
    terrain = terrain_map.stack([build(np.zeros((0, 5))), build(BOXES)])
    at = jax.vmap(lambda w: obstacles.collides(terrain.select(w), jnp.zeros(2), 0.0, 1.0, 1.0))
    assert at(jnp.array([0, 1])).tolist() == [False, False]
    hit = jax.vmap(lambda w: obstacles.collides(terrain.select(w), jnp.array([3, 4]), 0.0, 1, 1))
    assert hit(jnp.array([0, 1])).tolist() == [False, True]


def test_the_gap_is_no_more_than_the_distance_and_the_same_beside_a_box():
    rng = np.random.default_rng(1)
    xy, yaw = rng.uniform(-9, 9, (60, 2)), rng.uniform(-4, 4, 60)
    found = obstacles.gap(build(BOXES), jnp.array(xy), jnp.array(yaw), 4.6, 2.1)
    touches = obstacles.collides(build(BOXES), jnp.array(xy), jnp.array(yaw), 4.6, 2.1)
    np.testing.assert_array_equal(found <= 0, touches)
    along = np.linspace(0, 1, 41)[:, None]
    for i in np.flatnonzero(~touches):
        outline = corners(*xy[i], yaw[i], 4.6, 2.1)
        edges = np.concatenate(
            [a + along * (b - a) for a, b in zip(outline, np.roll(outline, 1, 0), strict=True)]
        )
        apart = [np.abs(edges - box[:2]) - box[2:4] / 2 for box in BOXES[:3]]
        nearest = min(np.linalg.norm(np.maximum(x, 0), axis=1).min() for x in apart)
        assert 0 < found[i] <= nearest + 0.05
        assert found[i] >= 0.7 * nearest - 0.05
    terrain = build(np.array([[0, 0, 2, 4, 1]]))
    for place, expected in (((6.0, 1.0), 2.7), ((0.0, -4.0), 0.95), ((3.0, 0.0), -0.3)):
        beside = obstacles.gap(terrain, jnp.array(place), jnp.float32(0), 4.6, 2.1)
        np.testing.assert_allclose(beside, expected, atol=1e-5)
    assert obstacles.gap(build(np.zeros((0, 5))), jnp.zeros(2), jnp.float32(0), 4, 2) == np.inf
