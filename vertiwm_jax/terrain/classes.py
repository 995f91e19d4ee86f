"""Ground classes: names, colors, friction and soils, and the standard ten of Verti-Bench."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vertiwm_jax.terrain import soil
from vertiwm_jax.terrain.soil import Soil


@dataclass(frozen=True)
class GroundClasses:
    """The meaning of the ids `0..K-1` of a semantic raster. A class with a soil is deformable.

    rgb: `[K, 3]` uint8 palette.
    friction: `[K]` mean friction coefficient; 0 for soils.
    soils: the soil of each deformable class, by name.
    """

    names: tuple[str, ...]
    rgb: np.ndarray
    friction: np.ndarray
    soils: Mapping[str, Soil]

    @property
    def deformable(self) -> np.ndarray:
        """`[K]` bool."""
        return np.array([name in self.soils for name in self.names])

    def stacked_soils(self) -> Soil:
        """Soils with leaves `[K]`; rows of rigid classes hold sand and are never used."""
        return soil.stack([self.soils.get(name, soil.PRESETS["sand"]) for name in self.names])


_TABLE = {
    # name: (red, green, blue), mean friction coefficient (Verti-Bench; 0 is soil)
    "clay": ((178, 90, 60), 0.60),
    "concrete": ((160, 160, 165), 0.85),
    "dirt": ((120, 80, 50), 0.60),
    "grass": ((80, 150, 60), 0.36),
    "gravel": ((140, 130, 110), 0.55),
    "rock": ((90, 95, 105), 0.65),
    "wood": ((190, 140, 80), 0.45),
    "mud": ((70, 50, 35), 0.0),
    "sand": ((225, 200, 130), 0.0),
    "snow": ((240, 245, 255), 0.0),
}

STANDARD = GroundClasses(
    names=tuple(_TABLE),
    rgb=np.array([rgb for rgb, _ in _TABLE.values()], np.uint8),
    friction=np.array([friction for _, friction in _TABLE.values()], np.float32),
    soils={name: soil.PRESETS[name] for name in ("mud", "sand", "snow")},
)
"""The ten classes of Verti-Bench; ids 0 to 6 are rigid, 7 to 9 are soils."""

FIRST_DEFORMABLE = 7
