import re

import jax
import numpy as np
import pytest

from vertiwm_jax.terrain.soil import PRESETS, out_of_range, stack


def test_presets_are_si_and_within_range():
    for name, soil in PRESETS.items():
        assert not out_of_range(soil), name
    sand = PRESETS["sand"]  # Verti-Bench: 5301e3, 102e3, .793, 1300 Pa, 31.1 deg, 12 mm
    values = [sand.kphi, sand.kc, sand.n, sand.cohesion, sand.friction_angle, sand.shear_modulus]
    np.testing.assert_allclose(
        values, [5301e3, 102e3, 0.793, 1300, np.deg2rad(31.1), 0.012], rtol=1e-6
    )


def test_stack_adds_a_leading_axis_in_float32():
    soils = stack([PRESETS["mud"], PRESETS["snow"], PRESETS["lunar"]])
    assert all(x.shape == (3,) and x.dtype == np.float32 for x in jax.tree.leaves(soils))
    np.testing.assert_allclose(soils.kphi, [2e6, 2e5, 8.2e5])
    with pytest.raises(ValueError, match="at least one soil"):
        stack([])


@pytest.mark.parametrize(
    ("field", "value", "hint"),
    [
        ("friction_angle", 30.0, "degrees"),
        ("kphi", -1.0, "kN"),
        ("n", float("nan"), "dimensionless"),
        ("cohesion", [0.0, -5.0], "Pa"),
        ("shear_modulus", 2.5, "cm"),
    ],
)
def test_bad_parameters_are_named_with_a_hint(field, value, hint):
    found = out_of_range(PRESETS["mud"].replace(**{field: np.asarray(value)}))
    assert re.match(rf"{field} of .*, outside .*{hint}", found)
