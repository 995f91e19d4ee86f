import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.networks.soil_predictor import SoilPredictor
from vertiwm_jax.terrain.soil import BOUNDS, PRESETS, out_of_range

MODEL = SoilPredictor()
LATENT = jax.random.normal(jax.random.key(1), (4, 16, 16, 18))
PARAMS = MODEL.init(jax.random.key(0), LATENT)
# Presets that are cohesionless or purely frictional have a zero here.
MAY_BE_ZERO = ("kc", "cohesion")


def test_parameters_are_those_of_the_paper():
    assert sum(x.size for x in jax.tree.leaves(PARAMS)) == 28_262


def test_cost():
    apply = jax.jit(MODEL.apply)
    cost = apply.lower(PARAMS, LATENT[:1]).compile().cost_analysis()
    assert cost["flops"] < 1.5e6


def test_soil_of_every_batch_element_is_its_own():
    soil = MODEL.apply(PARAMS, LATENT)
    for leaf in jax.tree.leaves(soil):
        assert leaf.shape == (4,)
    single = MODEL.apply(PARAMS, LATENT[2])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[2], b, rtol=1e-5), soil, single)
    assert len(np.unique(np.asarray(soil.kphi))) == 4
    np.testing.assert_array_equal(soil.unit_weight, 0)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3])
def test_soils_are_physical_and_gradients_finite(scale):
    def total(params, latent):
        soil = MODEL.apply(params, latent)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(soil)), soil

    gradient, soil = jax.grad(total, argnums=(0, 1), has_aux=True)(PARAMS, scale * LATENT)
    assert not out_of_range(soil)
    for field, (low, high) in BOUNDS.items():
        value = np.asarray(getattr(soil, field))
        assert np.all(value >= low * (1 - 1e-5)) and np.all(value <= high * (1 + 1e-5)), field
    assert all(bool(jnp.all(jnp.isfinite(g))) for g in jax.tree.leaves(gradient))


@pytest.mark.parametrize("name", PRESETS)
def test_bounds_hold_every_preset_with_room(name):
    for field, (low, high) in BOUNDS.items():
        value = float(getattr(PRESETS[name], field))
        assert value < high / 1.2, field
        assert value > low * 1.2 or (value == 0 and field in MAY_BE_ZERO), field


def test_order_of_outputs_is_that_of_the_bounds_and_of_soil():
    fields = [field.name for field in dataclasses.fields(PRESETS["sand"])]
    assert list(BOUNDS) == fields[:-1] and fields[-1] == "unit_weight"


def test_zero_weights_give_the_middle_of_the_bounds():
    soil = MODEL.apply(jax.tree.map(jnp.zeros_like, PARAMS), LATENT[0])
    for field in ("kc", "kphi", "cohesion", "shear_modulus"):
        np.testing.assert_allclose(getattr(soil, field), np.sqrt(np.prod(BOUNDS[field])), rtol=1e-5)
    for field in ("n", "friction_angle"):
        np.testing.assert_allclose(getattr(soil, field), np.mean(BOUNDS[field]), rtol=1e-5)
