"""What Chrono is told of a map, noted by something that stands for its modules."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from vertiwm_jax.simulators.chrono_ground import NO_SOIL, Ground, rectangles
from vertiwm_jax.terrain.map import TerrainMap

CONCRETE, SAND = 1, 8


def test_rectangles_cover_a_mask_once():
    mask = np.random.default_rng(0).random((16, 16)) < 0.7
    covered = np.zeros(mask.shape, int)
    for i0, i1, j0, j1 in rectangles(mask):
        covered[i0:i1, j0:j1] += 1
    np.testing.assert_array_equal(covered, mask)


class Recorder:
    """Stands for a module of PyChrono and for all in it: notes what it is called with."""

    SoilParametersCallback = object

    def __init__(self, calls, name=""):
        self._calls, self._name = calls, name

    def __getattr__(self, name):
        return Recorder(self._calls, name)

    def __call__(self, *arguments):
        self._calls.append((self._name, arguments))
        return arguments if self._name in ("ChVector3d", "ChCoordsysd") else self

    @staticmethod
    def doublep_assign(slot, value):
        slot.append(value)


@pytest.fixture
def images(monkeypatch):
    """Heights that were written for Chrono, by path."""
    written = {}

    def save(image, path):
        written[path] = np.asarray(image, float) / 65535

    monkeypatch.setattr(Image.Image, "save", save)
    return written


def world(cells):
    """128 m x 128 m with sand in its eastern half, and concrete of two frictions in the west."""
    height = 0.05 * np.arange(129) + np.linspace(3, 0, 129)[:, None] ** 2
    semantic = np.full((cells, cells), CONCRETE)
    semantic[:, cells // 2 :] = SAND
    friction = np.full(semantic.shape, 0.5)
    friction[: cells // 2] = 0.7
    boxes = np.array([[110.0, 4.0, 2.0, 3.0, 1.0], [0, 0, 0, 0, 0]])
    return height, TerrainMap.from_array(
        height, semantic, friction=friction, obstacles=boxes, origin=(100.0, 64.0)
    )


def named(calls, name):
    return [arguments for called, arguments in calls if called == name]


@pytest.mark.parametrize("cells", [16, 128, 129])
def test_rigid_patches_are_the_map(cells, images):
    height, terrain = world(cells)
    calls = []
    Ground(terrain).add_rigid(Recorder(calls), Recorder(calls), None)
    np.testing.assert_allclose(named(calls, "SetFriction"), [[0.5], [0.7]], atol=1e-6)
    patches = named(calls, "AddPatch")
    assert len(patches) == 2
    for _, ((x, y, _), _), image, length, width, low, high, *_ in patches:
        assert length == 64 and abs(width - 64) <= 1
        heights = low + (high - low) * images[image]
        xs = 164 + x + np.linspace(-length / 2, length / 2, heights.shape[1])
        ys = y + np.linspace(width / 2, -width / 2, heights.shape[0])
        assert xs[0] == 100 and max(abs(ys)) == 64
        rows, columns = (64 - ys).astype(int), (xs - 100).astype(int)
        np.testing.assert_allclose(heights, height[np.ix_(rows, columns)], atol=1e-3)


def test_soil_is_the_map(images):
    height, terrain = world(16)
    calls = []
    found = Ground(terrain)
    found.add_soil(Recorder(calls), None)
    ((image, *size_and_range),) = named(calls, "Initialize")
    np.testing.assert_allclose(size_and_range, [128, 128, 0, height.max(), 0.1], rtol=1e-6)
    np.testing.assert_allclose(height.max() * images[image], height, atol=1e-3)
    ((soil_map,),) = named(calls, "RegisterSoilParametersCallback")
    sand = (5301e3, 102e3, 0.793, 1.3e3, 31.1, 0.012, 4e8, 3e4)
    for x, y, soft in [(1, 0, 1), (-1, 0, 0), (63.9, -63.9, 1), (70, 70, 1), (-70, -70, 0)]:
        slots = [[] for _ in range(8)]
        soil_map.Set(SimpleNamespace(x=x, y=y), *slots)
        np.testing.assert_allclose(np.ravel(slots), sand if soft else NO_SOIL, rtol=1e-6)
        assert found.is_soft(np.array([[x, y]])).tolist() == [bool(soft)]


def test_obstacles_stand_as_high_as_on_the_map():
    height, terrain = world(16)
    calls = []
    Ground(terrain).add_boxes(Recorder(calls), Recorder(calls))
    ((length, width, tall, *_),) = named(calls, "ChBodyEasyBox")
    ((x, y, z),) = named(calls, "ChVector3d")
    assert (length, width, tall / 2) == (2, 3, 1)
    assert (x, y) == (110 - 164, 4) and math.isclose(z, height[60, 10], rel_tol=1e-5)
