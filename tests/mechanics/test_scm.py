"""The soil contact model against columns of ground in NumPy, its limits and its gradients."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.mechanics.scm import ScmParams
from vertiwm_jax.mechanics.wheel import MAX_SINKAGE, Wheel
from vertiwm_jax.terrain.soil import PRESETS, stack

WHEEL = Wheel(0.467, 0.254)
SOILS = stack([PRESETS[name] for name in ("mud", "sand", "snow")])
MUD, SAND, SNOW = 0, 1, 2
SHARP = ScmParams(creep_speed=1e-5)
"""Shear as in Chrono: at full strength at any slip."""
SMOOTH = ScmParams(creep_speed=0.4)


def scm_forces(wheel, soil, contact, sinkage, vx, vy, omega, *rut, nodes=6):
    contact = replace(contact, nodes=nodes)
    return contact.forces(wheel, soil, sinkage, (vx, vy, omega), *rut)


run = jax.jit(scm_forces, static_argnames="nodes")

CASES = [  # soil, sinkage m, hub m/s, lateral m/s, rim m/s, rut m
    (MUD, 0.05, 4.0, 0.0, 4.4, 0.0),
    (MUD, 0.05, 0.5, 0.0, 10.0, 0.0),
    (MUD, 0.08, 4.0, 0.0, 4.0, 0.0),
    (MUD, 0.08, 4.0, 0.0, 2.0, 0.0),
    (MUD, 0.08, 4.0, 0.0, -1.0, 0.0),
    (SAND, 0.02, 8.0, 0.0, 10.0, 0.0),
    (SAND, 0.03, 4.0, 1.0, 4.0, 0.0),
    (SAND, 0.03, 4.0, 0.0, 0.0, 0.0),
    (SNOW, 0.25, 2.0, 0.0, 4.0, 0.0),
    (SNOW, 0.25, 2.0, 0.0, 2.2, 0.0),
    (SNOW, 0.25, 2.0, 0.0, 2.0, 0.0),
    (SNOW, 0.25, 2.0, 0.5, 2.4, 0.0),
    (SNOW, 0.20, 5.0, 0.0, 3.0, 0.0),
    (MUD, 0.08, 2.0, -1.0, 4.0, 0.05),
    (SAND, 0.03, 4.0, 0.3, 4.4, 0.02),
    (SNOW, 0.25, 2.0, 0.5, 1.0, 0.10),
    (SNOW, 0.60, 2.0, 0.3, 3.0, 0.0),
    (SNOW, 0.60, 2.0, 0.0, 2.2, 0.05),
]


def soil_of(index):
    return jax.tree.map(lambda x: x[index], SOILS)


def outputs(f):
    return np.stack([f.longitudinal, f.lateral, f.normal, f.torque], -1)


def reference(soil, contact, sinkage, hub, lateral, rim, rut, columns=1000):
    """Fx, Fy, Fz, T in float64 of a wheel that rolls forwards over columns of ground.

    The columns stay where they are and remember how far they were pressed and sheared; the wheel
    moves on by a column a step, until it has left the ground on which it was put down.
    """
    kc, kphi, n, cohesion, phi, modulus, _ = (float(x) for x in jax.tree.leaves(soil))
    r, b, omega = WHEEL.radius, WHEEL.width, rim / WHEEL.radius
    lift = r - sinkage  # of the hub above the undisturbed ground
    reach = np.sqrt(r**2 - max(lift + rut, 0.0) ** 2)
    spacing = reach / columns
    x = (np.arange(2 * columns + 1) + 0.5) * spacing
    pressed, sheared = np.full((2, len(x)), float(rut))
    for step in range(1, 2 * columns):
        ahead = x - (step * spacing - reach)
        arm = np.sqrt(np.maximum(r**2 - ahead**2, 0.0))
        # Soil does not spring back: a column is in contact while it is pressed further.
        touched = (np.abs(ahead) < r) & (arm - lift > pressed + 1e-9)
        ahead, arm = ahead[touched], arm[touched]
        z = pressed[touched] = arm - lift
        backwards, downwards = omega * arm - hub, omega * ahead
        speed = np.maximum(np.hypot(backwards, lateral), 1e-12)
        sheared[touched] += speed * spacing / hub
        length = spacing * len(z)
        sigma = (kc * (1 / b + 1 / length) + kphi) * z**n
        sigma += float(contact.damping) * np.maximum(downwards, 0.0)
        tau = cohesion + sigma * np.tan(phi)
        tau *= (1 - np.exp(-sheared[touched] / modulus)) / speed
        fresh = hub / np.hypot(hub, float(contact.fresh_speed))
        moment = tau * backwards * arm + fresh * sigma * ahead
        stresses = tau * backwards, -tau * lateral, sigma, moment
    return spacing * b * np.array([s.sum() for s in stresses])


def test_agrees_with_columns_that_stay_put():
    index, sinkage, hub, lateral, rim, rut = (np.array(c) for c in zip(*CASES, strict=True))
    arguments = (SHARP, sinkage, hub, lateral, rim / WHEEL.radius, rut)
    got, few = (outputs(run(WHEEL, soil_of(index), *arguments, nodes=nodes)) for nodes in (12, 4))
    for i, case in enumerate(CASES):
        want = reference(soil_of(case[0]), SHARP, *case[1:])
        scale = want[2] * np.array([1, 1, 1, WHEEL.radius])
        np.testing.assert_allclose(got[i] / scale, want / scale, atol=1e-3, err_msg=str(case))
        np.testing.assert_allclose(few[i] / scale, want / scale, atol=4e-3, err_msg=str(case))


def states(count):
    """Soils and random sinkage, hub velocities, spin and rut of wheels in contact."""
    rng = np.random.default_rng(0)
    index = rng.integers(3, size=count)
    sinkage = np.array([0.1, 0.04, 0.35])[index] * rng.uniform(0.1, 1, count)
    hub, rim = rng.uniform(0, 6, (2, count))
    rut = sinkage * np.maximum(rng.uniform(-1, 0.9, count), 0)
    return soil_of(index), (sinkage, hub, rng.normal(size=count), rim / WHEEL.radius, rut)


def test_quadrature_converges():
    soil, state = states(4000)
    exact = run(WHEEL, soil, SMOOTH, *state, nodes=48)
    scale = np.asarray(exact.normal)[:, None] * np.array([1, 1, 1, WHEEL.radius])
    for nodes, bound in ((4, 1e-2), (6, 4e-3), (12, 5e-4)):
        error = outputs(run(WHEEL, soil, SMOOTH, *state, nodes=nodes)) - outputs(exact)
        assert np.quantile(np.abs(error / scale).max(-1), 0.99) < bound, nodes


def test_full_slip_reaches_the_friction_angle_and_standing_still_has_no_force_along():
    for soil in (MUD, SNOW):
        f = run(WHEEL, soil_of(soil), SHARP, 0.06, 0.01, 0.0, 10.0)
        np.testing.assert_allclose(f.longitudinal / f.normal, np.tan(np.radians(30)), rtol=1e-3)
    still = run(WHEEL, SOILS, SMOOTH, 0.03, 0.0, 0.0, 0.0)
    assert np.all(still.normal > 0)
    for x in (still.longitudinal, still.lateral, still.torque):
        np.testing.assert_array_equal(x, 0.0)


def test_shear_stays_inside_the_cone_of_friction_and_opposes_the_slip():
    soil, (sinkage, hub, lateral, omega, rut) = states(4000)
    f = run(WHEEL, soil, SMOOTH, sinkage, hub, lateral, omega, rut)
    area = WHEEL.width * WHEEL.radius
    bound = np.tan(soil.friction_angle) * f.normal + soil.cohesion * area
    assert np.all(np.hypot(f.longitudinal, f.lateral) <= bound)
    assert np.all(f.lateral * lateral <= 0)
    dragging = WHEEL.radius * omega * (1 - sinkage / WHEEL.radius) > hub
    assert dragging.any() and np.all(np.asarray(f.longitudinal)[dragging] > 0)
    pushing = WHEEL.radius * omega < hub
    assert pushing.any() and np.all(np.asarray(f.longitudinal)[pushing] < 0)


@pytest.mark.integration
def test_a_wheel_without_torque_is_braked_most_by_the_softest_soil():
    omega = np.linspace(0, 3, 601) / WHEEL.radius
    drag = []
    for soil in (SAND, MUD, SNOW):
        sinkage = sunk(soil_of(soil), SMOOTH, 6000.0, 2.0, 0.0, omega)
        f = run(WHEEL, soil_of(soil), SMOOTH, sinkage, 2.0, 0.0, omega)
        free = np.argmin(np.abs(f.torque))
        assert abs(f.torque[free]) < 10 and omega[free] < 2.0 / WHEEL.radius
        drag.append(-f.longitudinal[free])
    assert 0 < drag[0] < drag[1] < drag[2]


def test_compaction_resists_travel_and_not_spin_in_place():
    contacts = (SMOOTH, replace(SMOOTH, fresh_speed=1e9), replace(SMOOTH, fresh_speed=0.0))
    for speed, like in ((0.0, 1), (20.0, 2)):
        torque, other = (
            run(WHEEL, SOILS, contacts[i], 0.05, speed, 0.0, 60.0).torque for i in (0, like)
        )
        np.testing.assert_allclose(torque, other, rtol=2e-3)
    slow = [run(WHEEL, SOILS, contact, 0.05, 1.0, 0.0, 60.0).torque for contact in contacts]
    assert np.all(slow[1] < slow[0]) and np.all(slow[0] < slow[2])


def sunk(soil, contact, load, *motion):
    """Sinkage m, to a tenth of a millimetre, at which the soil carries a load."""
    depth = np.linspace(0, 0.6, 6001)[:, None]
    normal = np.asarray(run(WHEEL, soil, contact, depth, *motion).normal)
    return depth[(normal < load).sum(0), 0]


@pytest.mark.parametrize("soil", [MUD, SAND, SNOW])
def test_a_wheel_that_spins_faster_sinks_less(soil):
    omega = np.array([0.0, 4.0, 10.0, 20.0])
    depths = sunk(soil_of(soil), SMOOTH, 6000.0, 1.0, 0.0, omega)
    assert np.all(np.diff(depths) < 0)
    undamped = sunk(soil_of(soil), replace(SMOOTH, damping=0.0), 6000.0, 1.0, 0.0, omega)
    assert np.ptp(undamped) == 0 and depths[0] == undamped[0]


def test_reversing_mirrors_driving_and_left_mirrors_right():
    soil, (sinkage, hub, lateral, omega, rut) = states(1000)
    there = outputs(run(WHEEL, soil, SMOOTH, sinkage, hub, lateral, omega, rut))
    back = outputs(run(WHEEL, soil, SMOOTH, sinkage, -hub, lateral, -omega, rut))
    np.testing.assert_allclose(back, there * [-1, 1, 1, -1], rtol=1e-6)
    left = outputs(run(WHEEL, soil, SMOOTH, sinkage, hub, -lateral, omega, rut))
    np.testing.assert_allclose(left, there * [1, -1, 1, 1], rtol=1e-6)


def test_soil_carries_from_the_floor_of_the_rut_and_more_the_deeper():
    motion = (2.0, 0.3, 6.0)
    for sinkage, rut in ((-0.1, 0.0), (0.0, 0.0), (0.03, 0.05), (0.05, 0.05)):
        assert not outputs(run(WHEEL, SOILS, SMOOTH, sinkage, *motion, rut)).any()
    # Also beyond the hub, where the sides of the wheel have passed the surface.
    deep = np.linspace(0, MAX_SINKAGE * WHEEL.radius, 400)[1:, None]
    for rut in (0.0, 0.05):
        normal = np.asarray(run(WHEEL, SOILS, SMOOTH, deep + rut, *motion, rut).normal)
        assert np.all(np.diff(normal, axis=0) > 0)
    # A rut takes away more of the contact than its floor adds.
    fresh, second = (run(WHEEL, SOILS, SMOOTH, 0.06, *motion, rut).normal for rut in (0.0, 0.05))
    assert np.all(second < fresh)


def test_no_jump_from_braking_through_rolling_to_driving():
    for omega in (np.linspace(-1.0, 9.0, 2001), np.linspace(4.2, 4.4, 2001)):
        f = outputs(run(WHEEL, soil_of(SNOW), SMOOTH, 0.2, 2.0, 0.2, omega))
        assert np.abs(np.diff(f, axis=0)).max() < 0.02 * f[:, 2].max()
    speed = np.linspace(-0.1, 0.1, 2001)
    locked = outputs(run(WHEEL, soil_of(SNOW), SMOOTH, 0.2, speed, 0.0, 0.0))
    assert np.abs(np.diff(locked, axis=0)).max() < 0.02 * locked[:, 2].max()
    assert np.all(locked[:, 0] * speed <= 0)


def test_values_and_gradients_are_finite_in_every_corner():
    clay = PRESETS["heavy_clay_25"]  # n of 0.13
    soils = stack([*(PRESETS[name] for name in ("mud", "sand", "snow")), clay])
    corners = itertools.product(
        range(4),
        [-0.1, 0.0, 1e-7, 1e-3, 0.2, 0.467, 0.9],
        [-5.0, 0.0, 1e-6, 1.0],
        [-3.0, 0.0, 1e-4],
        [-40.0, 0.0, 1e-6, 1 / 0.467, 5 / 0.467],
        [0.0, 0.1],
    )
    grid = np.array(list(corners), np.float32)
    soil = jax.tree.map(lambda x: x[grid[:, 0].astype(int)], soils)

    def total(wheel, soil, contact, *state):
        f = scm_forces(wheel, soil, contact, *state)
        return sum(jnp.sum(x) for x in jax.tree.leaves(f)), f

    wheel, contact = jax.tree.map(jnp.float32, (WHEEL, SMOOTH))
    derive = jax.value_and_grad(total, argnums=tuple(range(8)), has_aux=True)
    (_, f), gradient = jax.jit(derive)(wheel, soil, contact, *grid[:, 1:].T)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((f, gradient)))

    airborne = grid[:, 1] <= grid[:, 5]
    assert not outputs(f)[airborne].any() and outputs(f)[~airborne, 2].any()
    assert all(not np.any(x[airborne]) for x in gradient[3:])


def test_gradients_agree_with_differences():
    at = np.array(  # sinkage, hub, lateral, spin, rut, kphi, damping
        [
            [0.08, 4.0, 0.5, 10.0, 0.0, 1.0, 1.0],
            [0.08, 4.0, -0.5, 7.0, 0.03, 1.0, 1.0],
            [0.05, 2.0, 0.3, 4.5, 0.0, 1.0, 1.0],
        ]
    )
    step = np.array([1e-3, 2e-2, 2e-2, 5e-2, 1e-3, 1e-2, 2e-2])
    moved = np.array([True, True, True, True, False, True, True])  # a rut of 0 is an edge

    def at_state(x):
        soil = soil_of(MUD)
        soil = replace(soil, kphi=x[5] * soil.kphi)
        contact = replace(SMOOTH, damping=x[6] * SMOOTH.damping)
        f = scm_forces(WHEEL, soil, contact, *x[:5], nodes=12)
        return jnp.stack([f.longitudinal, f.lateral, f.normal, f.torque])

    f = jax.jit(jax.vmap(at_state))
    forward = jax.jit(jax.vmap(jax.jacfwd(at_state)))(jnp.float32(at))
    reverse = jax.jit(jax.vmap(jax.jacrev(at_state)))(jnp.float32(at))
    np.testing.assert_allclose(forward, reverse, rtol=1e-3, atol=1.0)
    for i, d in enumerate(np.diag(step)):
        rows = slice(None) if moved[i] else slice(1, 2)
        difference = (f(jnp.float32(at + d)) - f(jnp.float32(at - d)))[rows] / (2 * step[i])
        scale = np.abs(difference).max()
        np.testing.assert_allclose(
            forward[rows, :, i], difference, rtol=0.03, atol=0.01 * scale, err_msg=str(i)
        )


def test_broadcasts_and_batches_alike():
    sinkage, omega = np.linspace(0.01, 0.2, 5, dtype=np.float32), jnp.array([2.0, 8.0])
    whole = run(WHEEL, SOILS, SMOOTH, sinkage[:, None, None], 2.0, 0.3, omega[:, None])
    assert all(x.shape == (5, 2, 3) and x.dtype == jnp.float32 for x in jax.tree.leaves(whole))
    mapped = jax.vmap(lambda z: scm_forces(WHEEL, SOILS, SMOOTH, z, 2.0, 0.3, omega[:, None]))
    np.testing.assert_allclose(outputs(mapped(sinkage)), outputs(whole), rtol=1e-5)
    alone = scm_forces(WHEEL, soil_of(SNOW), SMOOTH, sinkage[1], 2.0, 0.3, omega[1])
    np.testing.assert_allclose(outputs(alone), outputs(whole)[1, 1, SNOW], rtol=1e-5)
