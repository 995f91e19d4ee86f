from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logit

from benchmarks.soil_adaptation import mistaken
from vertiwm_jax.adaptation import soil_filter
from vertiwm_jax.adaptation.soil_filter import SoilFilter, believed
from vertiwm_jax.mechanics.equilibrium import equilibrium_sinkage
from vertiwm_jax.mechanics.kinematic import bicycle_of, place
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like, stiffened
from vertiwm_jax.mechanics.vehicle import GRAVITY, load_vehicle
from vertiwm_jax.mechanics.wheel import Wheel
from vertiwm_jax.models.registry import load_model
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import PRESETS, to_unit

GRASS, MUD, SAND = 3, 7, 8
EFFECT = 0.1 * np.random.default_rng(0).normal(size=(6, 6))
NOISE = (0.05, 0.05, 0.02, 0.03, 0.04, 0.02)


def ground(*kinds: int) -> terrain_map.TerrainMap:
    """Level, 64 m square, in stripes from west to east."""
    row = np.repeat(kinds, 8 // len(kinds))
    return TerrainMap.from_array(np.full((65, 65), 4.0), np.tile(row, (8, 1)))


@dataclass(frozen=True)
class Linear:
    """A vehicle that the logits of its soil move, once for every `period` steps of the history."""

    period: int

    def init(self, params, terrain, state):
        return jnp.int32(0)

    def step(self, params, terrain, history, state, command):
        kind = query.surface(terrain, state.position[:2]).semantic
        logits = logit(to_unit(query.soil(terrain, kind)))
        last = history % self.period == self.period - 1
        moved = jnp.where(last, params @ logits, 0.0)
        position = state.position + moved[:3] + jnp.stack([0.1 * command.speed, 0.0, 0.0])
        return replace(state, position=position), history + 1


def still(x: jax.Array | float = 0.0) -> VehicleState:
    return VehicleState(jnp.array([x, 0.0, 4.5]), jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))


def test_on_a_linear_system_it_is_kalmans_filter_that_forgets():
    """Every four steps, after two of context, a displacement is measured that logits decide."""
    settings = SoilFilter(context=2, horizon=4, prior=1.0, memory=0.9, noise=NOISE, gate=1e9)
    terrain, model = ground(MUD), Linear(6)
    rng = np.random.default_rng(1)
    x = np.zeros(21)
    for i in range(1, 21):
        x[i] = x[i - 1] + rng.normal(0, 0.1)
    drive = jax.vmap(still)(jnp.asarray(x, jnp.float32))

    @jax.jit
    def filtered(drive):
        first = settings.init(terrain, jax.tree.map(lambda x: x[0], drive))

        def step(belief, state):
            command = Command(jnp.float32(0), jnp.float32(0))
            belief = settings.update(model, jnp.asarray(EFFECT), terrain, belief, state, command)
            return belief, belief.soils

        return jax.lax.scan(step, first, jax.tree.map(lambda x: x[1:], drive))

    last, soils = filtered(drive)
    start = settings.init(terrain, still()).soils
    mean0, covariance0 = np.asarray(start.mean[MUD]), np.asarray(start.covariance[MUD])
    mean, covariance = mean0.astype(float), covariance0.astype(float)
    # Increments of pure translations are the differences of positions.
    matrix, noise = np.vstack([EFFECT[:3], np.zeros((3, 6))]), np.diag(np.square(NOISE))
    for i in range(1, 21):
        if i % 4 == 0:
            mean = mean0 + 0.9 * (mean - mean0)
            covariance = 0.81 * covariance + 0.19 * covariance0
        if i in (8, 12, 16, 20):
            moved = np.array([x[i] - x[i - 4], 0, 0, 0, 0, 0])
            spread = matrix @ covariance @ matrix.T + noise
            gain = covariance @ matrix.T @ np.linalg.inv(spread)
            mean = mean + gain @ (moved - matrix @ mean)
            covariance = covariance - gain @ matrix @ covariance
        np.testing.assert_allclose(soils.mean[i - 1, MUD], mean, atol=2e-4)
        np.testing.assert_allclose(soils.covariance[i - 1, MUD], covariance, atol=2e-4)
    assert last.accepted[MUD] == 4 and last.accepted.sum() == 4 and last.refused.sum() == 0
    # Other soils are as the map has them.
    np.testing.assert_allclose(soils.mean[-1, SAND], start.mean[SAND], atol=1e-6)
    assert np.abs(mean - mean0).max() > 0.1


def along(settings, terrain, positions, speed=0.0, belief=None):
    """The belief after steps through these positions, driven by nothing."""
    belief = belief or settings.init(terrain, still(positions[0]))
    model, effect = Linear(6), jnp.asarray(EFFECT)
    command = Command(jnp.float32(speed), jnp.float32(0))
    update = jax.jit(lambda b, s: settings.update(model, effect, terrain, b, s, command))
    for x in positions[1:]:
        belief = update(belief, still(x))
    return belief


def test_what_cannot_be_is_refused():
    settings = SoilFilter(context=2, horizon=4, memory=1.0)
    thrown = [0.0] * 8 + [20.0]  # as by a crash, or a jump of the localisation
    belief = along(settings, ground(MUD), thrown)
    assert belief.refused[MUD] == 1 and belief.accepted.sum() == 0
    start = settings.init(ground(MUD), still())
    np.testing.assert_allclose(belief.soils.mean, start.soils.mean, atol=1e-6)
    lost = along(settings, ground(MUD), [0.0] * 8 + [np.nan])
    assert np.isfinite(lost.soils.mean).all() and lost.accepted.sum() == 0


def test_only_one_kind_of_soil_at_a_time_is_learned_about():
    settings = SoilFilter(context=2, horizon=4)
    for terrain in (ground(GRASS), ground(MUD, SAND)):
        belief = along(settings, terrain, np.linspace(-1, 0.6, 9), speed=2.0)
        assert belief.accepted.sum() == 0 and belief.refused.sum() == 0


def test_another_drive_begins_with_what_is_known():
    settings = SoilFilter(context=2, horizon=4)
    belief = along(settings, ground(MUD), [0.0] * 9)
    assert belief.accepted[MUD] == 1
    again = along(settings, ground(MUD), [3.0] * 9, belief=replace(belief, steps=jnp.int32(0)))
    assert again.steps == 8 and again.accepted[MUD] == 2 and again.refused.sum() == 0


def test_at_first_the_map_is_believed():
    terrain = ground(MUD)
    soils = query.soils(believed(terrain, SoilFilter().init(terrain, still())))
    for name in ("kphi", "n", "friction_angle", "shear_modulus"):
        found, expected = getattr(soils, name), getattr(query.soils(terrain), name)
        np.testing.assert_allclose(found, expected, rtol=1e-4)
    # Mud has neither cohesion nor kc: as little of both as does not matter.
    assert soils.cohesion[MUD] < 20 and soils.kc[MUD] < 20
    np.testing.assert_array_equal(soils.unit_weight, terrain.soils.unit_weight[0])


def test_physics_is_differentiated_exactly_and_has_to_read_the_map():
    soil_filter._check(Simulator(), chrono_like(load_vehicle()))
    for name in ("nesam", "vertiwm"):
        soil_filter._check(*load_model(name, exact_gradient=True))
        with pytest.raises(ValueError, match=r"model: expected one of load_model.exact_gradient"):
            soil_filter._check(*load_model(name))
        with pytest.raises(ValueError, match=r"soil: expected 'map' .*, found 'predicted'"):
            soil_filter._check(*load_model(name, soil="predicted", exact_gradient=True))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"horizon": 0}, "horizon: expected at least 1, found 0"),
        ({"memory": 1.5}, "memory: expected more than 0 and at most 1, found 1.5"),
        ({"noise": (1, 1, 1, 1, 1, 0)}, "noise: expected more than 0, found"),
    ],
)
def test_bad_settings_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        SoilFilter(**settings)


def sinkage_and_pull(params, soil):
    """m and N, of one wheel under a quarter of the weight, at 2 m/s with 20 % slip."""
    vehicle, soil = params.vehicle, stiffened(params, soil)
    wheel, load = Wheel(vehicle.wheel_radius, vehicle.wheel_width), vehicle.mass * GRAVITY / 4
    motion = 2.0, 0.0, 2.0 / 0.8 / vehicle.wheel_radius
    sinkage = equilibrium_sinkage(wheel, soil, params.contact, load, motion)
    return sinkage, params.contact.forces(wheel, soil, sinkage, motion).longitudinal


@pytest.mark.slow
def test_a_soil_that_the_map_has_wrong_is_recovered_while_driving():
    terrain, params, model = ground(MUD), chrono_like(load_vehicle()), Simulator()
    vehicle = params.vehicle
    start = place(terrain, vehicle=replace(bicycle_of(vehicle), ride_height=jnp.float32(0.4)))
    time = 0.1 * jnp.arange(96)
    commands = Command(2.5 + 1.5 * jnp.sin(time), 0.3 * jnp.sin(0.7 * time))
    wrong = mistaken(terrain, PRESETS["snow"])
    settings, traces = SoilFilter(), 0

    @jax.jit
    def drive(true, wrong, start):
        """Drives on one ground and believes in another; beliefs after every step."""
        nonlocal traces
        traces += 1

        def step(carry, command):
            state, history, belief = carry
            state, history = model.step(params, true, history, state, command)
            belief = settings.update(model, params, wrong, belief, state, command)
            return (state, history, belief), belief

        first = start, model.init(params, true, start), settings.init(wrong, start)
        return jax.lax.scan(step, first, commands)[1]

    beliefs = drive(terrain, wrong, start)
    drive(terrain, terrain, start)
    assert traces == 1
    covariance = np.asarray(beliefs.soils.covariance, np.float64)
    np.testing.assert_array_equal(covariance, np.swapaxes(covariance, -1, -2))
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert beliefs.accepted[-1, MUD] >= 8

    last = jax.tree.map(lambda x: x[-1], beliefs)
    grounds = {"true": terrain, "wrong": wrong, "adapted": believed(wrong, last)}
    felt = {
        name: [float(x[MUD]) for x in sinkage_and_pull(params, query.soils(ground))]
        for name, ground in grounds.items()
    }
    for i in range(2):
        missed = {name: abs(x[i] / felt["true"][i] - 1) for name, x in felt.items()}
        assert missed["adapted"] < 0.3 * missed["wrong"]
