"""Builds one world of a map in Project Chrono: rigid height maps, SCM soil, boxes.

Chrono's origin is the middle of the map.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from PIL import Image

from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.files import soil_of_chrono
from vertiwm_jax.terrain.map import BY_WORLD, TerrainMap

RESTITUTION = 0.01
CELL = 0.1
"""m between the nodes of SCM's soil."""
ELASTICITY = {"mud": 2e8, "sand": 4e8, "snow": 4e7}
"""Stiffness, Pa/m, with which Verti-Bench's soils unload."""
STIFFENING = 100.0
"""The same for other soils, as a multiple of their kphi; that of mud."""
DAMPING = 3e4
"""Damping of all soils normal to the ground, Pa s/m."""
NO_SOIL = (0.0, 0.0, 1.0, 0.0, 0.0, 0.01, 1e-6, 0.0)
"""SCM's parameters where the ground is rigid: a soil without force."""
BULLDOZING = (55.0, 1.0, 5, 10)
"""Erosion angle in degrees, flow factor, iterations, propagations."""
GROUND_FAMILY = 14
"""Family of collision models of `RigidTerrain`, whose members do not touch each other."""
_GRAY = 65535


class Ground:
    """The selected world of a map on the host; points are about the middle of the map, m.

    middle: `[2]` x, y of it on the map; size: extent in x and y.
    soft: `[r, c]` whether cells, which hold whole squares of vertices, are soil.
    """

    def __init__(self, terrain: TerrainMap) -> None:
        self._terrain, world = terrain, int(terrain.world)
        self._heights, semantic, self._friction, self.boxes = (
            np.asarray(getattr(terrain, name)[world]) for name in BY_WORLD
        )
        squares = np.array(self._heights.shape) - 1
        self.size = squares[::-1] * float(terrain.resolution)
        self.middle = np.asarray(terrain.origin) + self.size / 2 * (1, -1)
        if (squares % semantic.shape).any():
            # Rigid patches begin and end at vertices: each square is of one class.
            places = [
                ((np.arange(n) + 0.5) * cells / n).astype(int)
                for n, cells in zip(squares, semantic.shape, strict=True)
            ]
            semantic, self._friction = (x[np.ix_(*places)] for x in (semantic, self._friction))
        self._semantic, self._across = semantic, squares // semantic.shape
        self.soft = np.asarray(terrain.deformable)[semantic]
        self._low = float(self._heights.min())
        self._high = max(float(self._heights.max()), self._low + 1.0)  # level ground has no range

    def elevation(self, points: np.ndarray) -> np.ndarray:
        """Undeformed heights `[...]` at points `[..., 2]`, m."""
        on_map = jnp.asarray(points + self.middle, jnp.float32)
        return np.asarray(query.surface(self._terrain, on_map).height)

    def is_soft(self, points: np.ndarray) -> np.ndarray:
        """`[N, 2]` to `[N]`; points off the map take the nearest cell."""
        rows, columns = self.soft.shape
        across, down = (points * (1, -1) / self.size + 0.5).T * ((columns,), (rows,))
        i = np.clip(np.floor(down), 0, rows - 1).astype(int)
        j = np.clip(np.floor(across), 0, columns - 1).astype(int)
        return self.soft[i, j]

    def add_rigid(self, chrono: Any, vehicle: Any, system: Any) -> Any:
        """Rigid ground, one height map for each rectangle of cells of one friction, if any."""
        if self.soft.all():
            return None
        rigid = vehicle.RigidTerrain(system)
        down, across = self._across
        spacing = self.size[0] / (self._heights.shape[1] - 1)
        with tempfile.TemporaryDirectory() as folder:
            for friction in np.unique(self._friction[~self.soft]):
                mask = (self._friction == friction) & ~self.soft
                for i0, i1, j0, j1 in rectangles(mask):
                    material = chrono.ChContactMaterialNSC()
                    material.SetFriction(float(friction))
                    material.SetRestitution(RESTITUTION)
                    top, bottom, left, right = i0 * down, i1 * down, j0 * across, j1 * across
                    image = self._image(folder, slice(top, bottom + 1), slice(left, right + 1))
                    x, y = spacing * (left + right) / 2, spacing * (top + bottom) / 2
                    center = chrono.ChVector3d(
                        float(x - self.size[0] / 2), float(self.size[1] / 2 - y), 0.0
                    )
                    rigid.AddPatch(
                        material, chrono.ChCoordsysd(center, chrono.QUNIT), image,
                        float(spacing * (right - left)), float(spacing * (bottom - top)),
                        self._low, self._high, True, 0.0, False,
                    )  # fmt: skip
            rigid.Initialize()
        return rigid

    def add_soil(self, vehicle: Any, system: Any) -> tuple[Any, Any]:
        """SCM over the whole map, and its callback, of which Chrono keeps no reference, if any."""
        if not self.soft.any():
            return None, None
        scm, callback = vehicle.SCMTerrain(system, False), None
        classes = np.unique(self._semantic)
        if len(classes) == 1:
            scm.SetSoilParameters(*self._soil(classes[0]))
        else:
            callback = self._soil_map(vehicle)
            scm.RegisterSoilParametersCallback(callback)
        scm.EnableBulldozing(True)
        scm.SetBulldozingParameters(*BULLDOZING)
        with tempfile.TemporaryDirectory() as folder:
            image = self._image(folder, slice(0, None), slice(0, None))
            scm.Initialize(image, *map(float, self.size), self._low, self._high, CELL)
        return scm, callback

    def add_boxes(self, chrono: Any, system: Any) -> None:
        """The obstacles of the map; they reach as far below the ground as they stand above it."""
        for x, y, length, width, height in self.boxes[self.boxes[:, 4] > 0].tolist():
            box = chrono.ChBodyEasyBox(
                length, width, 2 * height, 1000.0, False, True, chrono.ChContactMaterialNSC()
            )
            place = np.array([x, y]) - self.middle
            box.SetPos(chrono.ChVector3d(*place.tolist(), float(self.elevation(place))))
            box.SetFixed(True)
            # Boxes stand deep in the ground: their contacts with it took most of the time.
            model = box.GetCollisionModel()
            model.SetFamily(GROUND_FAMILY)
            model.DisallowCollisionsWith(GROUND_FAMILY)
            system.Add(box)

    def _image(self, folder: str, rows: slice, columns: slice) -> str:
        """Heights of vertices as 16-bit gray, from the lowest to the highest of the world."""
        gray = (self._heights[rows, columns] - self._low) / (self._high - self._low) * _GRAY
        path = str(Path(folder) / f"{rows.start}_{columns.start}.png")
        Image.fromarray(np.round(gray).astype(np.uint16)).save(path)
        return path

    def _soil(self, kind: int) -> tuple[float, ...]:
        """The parameters of SCM for a ground class."""
        name = self._terrain.class_names[kind]
        if not self._terrain.deformable[kind]:
            return NO_SOIL
        *soil, _ = soil_of_chrono(query.soils(self._terrain), kind)
        return (*soil, ELASTICITY.get(name, STIFFENING * soil[0]), DAMPING)

    def _soil_map(self, vehicle: Any) -> Any:
        """SCM's callback that gives the soil at a point; no force where the ground is rigid."""
        known = {int(kind): self._soil(kind) for kind in np.unique(self._semantic)}
        table = [[known[kind] for kind in row] for row in self._semantic.tolist()]
        rows, columns = self._semantic.shape
        (width, height), assign = self.size.tolist(), vehicle.doublep_assign

        # Called for every node that a wheel touches: plain Python is faster than NumPy here.
        class SoilMap(vehicle.SoilParametersCallback):
            def __init__(self) -> None:
                vehicle.SoilParametersCallback.__init__(self)

            def Set(self, loc: Any, *slots: Any) -> None:
                j = int((loc.x / width + 0.5) * columns)
                i = int((0.5 - loc.y / height) * rows)
                soil = table[min(max(i, 0), rows - 1)][min(max(j, 0), columns - 1)]
                for slot, value in zip(slots, soil, strict=False):
                    assign(slot, value)

        return SoilMap()


def rectangles(mask: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
    """Covers a mask with rectangles (i0, i1, j0, j1), half open: each as wide, then as high as may
    be from the first cell that is left."""
    left = mask.copy()
    while left.any():
        i0, j0 = np.argwhere(left)[0].tolist()
        j1 = j0 + int(np.argmin(np.append(left[i0, j0:], False)))
        i1 = i0 + int(np.argmin(np.append(left[i0:, j0:j1].all(axis=1), False)))
        left[i0:i1, j0:j1] = False
        yield i0, i1, j0, j1
