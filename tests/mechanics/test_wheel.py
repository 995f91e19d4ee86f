"""The wheel against adaptive quadrature, finite differences and what must hold everywhere."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from vertiwm_jax import froude
from vertiwm_jax.mechanics.bekker_wong import LUGGED_WHEEL, BekkerWongParams, travel
from vertiwm_jax.mechanics.equilibrium import equilibrium_sinkage
from vertiwm_jax.mechanics.wheel import Wheel, rigid_forces
from vertiwm_jax.terrain.soil import PRESETS, stack

WHEEL = Wheel(0.467, 0.254)
SOILS = stack([PRESETS[name] for name in ("sand", "heavy_clay_25", "snow_us")])


def forces(wheel, soil, contact, sinkage, vx, vy, omega, *rut, nodes=6):
    return contact.replace(nodes=nodes).forces(wheel, soil, sinkage, (vx, vy, omega), *rut)


run = jax.jit(forces, static_argnames="nodes")


def reference(soil, contact, sinkage, vx, vy, omega):
    """Fx, Fy, Fz, T of a wheel that moves forwards, in float64, by scipy's adaptive quadrature."""
    r, b = WHEEL.radius, WHEEL.width
    kc, kphi, n, c, phi, modulus, weight = (float(x) for x in jax.tree.leaves(soil))
    v, w = vx, r * omega
    s = 1 - v / w if w > v else w / v - 1
    n += contact.slip_sinkage * s if s > 0 else -contact.skid_sinkage * s
    th1 = np.arccos(1 - sinkage / r)
    thm = (contact.peak + contact.peak_slip * max(s, 0)) * th1
    th2 = (contact.exit + contact.exit_slip * max(s, 0)) * th1
    th2 -= np.arccos(1 - contact.rebound * sinkage / r)
    th0 = th1 * (1 + min(s, 0) / 2)
    chi = np.pi / 4 - phi / 2

    def stresses(th):
        mirrored = th if th >= thm else th1 - (th - th2) / (thm - th2) * (th1 - thm)
        z = r * max(np.cos(mirrored) - np.cos(th1), 0)
        sigma = (kc / b + kphi) * z**n
        if th > th0:
            mean = (np.sin(th1) - np.sin(th0)) / (th1 - th0)
            jx = v / omega * (mean * (th1 - th) - (np.sin(th1) - np.sin(th)))
            along = v * (mean - np.cos(th))
        else:
            jx = (w * (th0 - th) - v * (np.sin(th0) - np.sin(th))) / omega
            along = w - v * np.cos(th)
        jy = vy / omega * (th1 - th)
        tau = (c + sigma * np.tan(phi)) * (1 - np.exp(-np.hypot(jx, jy) / modulus))
        tau /= max(np.hypot(along, vy), 1e-12)
        return sigma, tau * along, -tau * vy

    def side(th):
        h = r * (np.cos(th) - np.cos(th1)) if abs(th) < th1 else 0.0
        d1 = 1 / np.tan(chi) + np.tan(chi + phi)
        d2 = 1 / np.tan(chi) + np.tan(phi) / np.tan(chi) ** 2
        pressure = d1 * (c * h + d2 * weight * h**2 / 2)
        return -pressure * (r - h * np.cos(th)) * vy / np.hypot(vx, vy)

    def integrate(f):
        mean = (np.sin(th1) - np.sin(th0)) / (th1 - th0) if th0 < th1 else np.cos(th1)
        turns = [thm, th0, np.arccos(mean), np.arccos(min(w / v, 1))]
        turns = sorted({float(np.clip(x, th2, th1)) for x in (th2, th1, *turns)})
        pieces = itertools.pairwise(turns)
        return sum(quad(f, *x, epsabs=0, epsrel=1e-7, limit=200)[0] for x in pieces)

    def fx(th):
        sigma, tau, _ = stresses(th)
        return r * b * (tau * np.cos(th) - sigma * np.sin(th))

    def fz(th):
        sigma, tau, _ = stresses(th)
        return r * b * (sigma * np.cos(th) + tau * np.sin(th))

    return np.array(
        [
            integrate(fx),
            integrate(lambda th: r * b * stresses(th)[2] + side(th)),
            integrate(fz),
            integrate(lambda th: r**2 * b * stresses(th)[1]),
        ]
    )


def test_agrees_with_adaptive_quadrature():
    contact = BekkerWongParams(
        peak=0.3,
        peak_slip=0.3,
        exit=-0.1,
        exit_slip=-0.1,
        rebound=0.2,
        slip_sinkage=0.2,
        skid_sinkage=0.1,
        creep_speed=1e-4,
    )
    cases = [  # soil, sinkage m, vx, vy m/s, omega rad/s
        (0, 0.02, 8.0, 0.0, 10 / 0.467),
        (0, 0.05, 10.0, 3.0, 6 / 0.467),
        (1, 0.01, 5.0, -2.0, 10 / 0.467),
        (1, 0.10, 9.0, 0.5, 9.2 / 0.467),
        (2, 0.25, 10.0, -4.0, 10 / 0.467),
        (2, 0.30, 10.0, 1.0, 3 / 0.467),
    ]
    index, *state = (np.array(column) for column in zip(*cases, strict=True))
    soil = jax.tree.map(lambda x: x[index], SOILS)
    f = run(WHEEL, soil, contact, *state, nodes=16)
    got = np.stack([f.longitudinal, f.lateral, f.normal, f.torque], -1)
    coarse = run(WHEEL, soil, contact, *state)
    for i, case in enumerate(cases):
        want = reference(jax.tree.map(lambda x, i=i: x[i], soil), contact, *case[1:])
        np.testing.assert_allclose(got[i], want, rtol=1e-4, atol=1e-4 * want[2], err_msg=str(case))
        np.testing.assert_allclose(coarse.longitudinal[i], want[0], atol=1e-3 * want[2])
        np.testing.assert_allclose(coarse.normal[i], want[2], rtol=1e-3)


@pytest.mark.parametrize(
    "contact",
    [
        BekkerWongParams(rebound=0.9, slip_sinkage=0.2, skid_sinkage=0.3),
        BekkerWongParams(bulldozing="wong"),
        LUGGED_WHEEL,
    ],
)
@pytest.mark.integration
def test_values_and_gradients_are_finite_in_every_corner(contact):
    corners = itertools.product(
        range(3),
        [-0.1, 0.0, 1e-7, 1e-3, 0.2, 0.467, 0.9],
        [-5.0, 0.0, 1e-6, 1.0],
        [-3.0, 0.0, 1e-4],
        [-40.0, 0.0, 1e-6, 1 / 0.467],
        [0.0, 0.1],
    )
    grid = np.array(list(corners), np.float32)
    soil = jax.tree.map(lambda x: x[grid[:, 0].astype(int)], SOILS)

    def total(wheel, soil, contact, *state):
        f = forces(wheel, soil, contact, *state)
        return sum(jnp.sum(x) for x in jax.tree.leaves(f)), f

    as_float = jax.tree.map(jnp.float32, (WHEEL, contact))
    arguments = (as_float[0], soil, as_float[1], *grid[:, 1:].T)
    derive = jax.value_and_grad(total, argnums=tuple(range(8)), has_aux=True)
    (_, f), gradient = jax.jit(derive)(*arguments)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((f, gradient)))

    airborne = grid[:, 1] <= 0
    assert all(not np.any(x[airborne]) for x in jax.tree.leaves(f))
    assert all(not np.any(x[airborne]) for x in gradient[3:])


def test_sliding_straight_to_the_side_knows_no_ahead():
    soil = jax.tree.map(lambda x: x[0], SOILS)
    # Locked; then spinning forwards and backwards.
    f = run(WHEEL, soil, LUGGED_WHEEL, 0.1, 0.0, -2.0, np.array([0.0, 8.0, -8.0]))
    np.testing.assert_allclose(f.longitudinal[0], 0, atol=1e-3 * f.normal[0])
    np.testing.assert_allclose(f.longitudinal[1], -f.longitudinal[2], rtol=1e-5)
    np.testing.assert_allclose(f.normal[1], f.normal[2], rtol=1e-5)
    assert f.longitudinal[1] > 0 and (f.lateral > 0).all()


def test_sliding_softens_soil():
    soil = jax.tree.map(lambda x: x[0], SOILS)
    aside, spin = np.float32([0.0, -1.0, -4.0, 0.0, 0.0]), np.float32([1, 1, 1, 4, 0]) / 0.467
    z = equilibrium_sinkage(WHEEL, soil, LUGGED_WHEEL, 6e3, (1.0, aside, spin))
    assert z[0] < z[1] < z[2] and z[0] < z[3] and z[0] < z[4]


@pytest.mark.integration
def test_gradients_agree_with_differences():
    soil = jax.tree.map(lambda x: x[0], SOILS)
    state = np.array([[0.03, 4.0, 0.5, 10.0], [0.03, 4.0, -0.5, 7.0], [0.05, 2.0, 0.3, 8.0]])
    step = np.array([1e-3, 2e-2, 2e-2, 5e-2])

    def outputs(x):
        f = forces(WHEEL, soil, BekkerWongParams(), *x, nodes=24)
        return jnp.stack([f.longitudinal, f.lateral, f.normal, f.torque])

    f = jax.jit(jax.vmap(outputs))
    forward = jax.jit(jax.vmap(jax.jacfwd(outputs)))(jnp.float32(state))
    reverse = jax.jit(jax.vmap(jax.jacrev(outputs)))(jnp.float32(state))
    np.testing.assert_allclose(forward, reverse, rtol=1e-3, atol=1.0)
    for i, d in enumerate(np.diag(step)):
        difference = (f(jnp.float32(state + d)) - f(jnp.float32(state - d))) / (2 * step[i])
        scale = np.abs(difference).max()
        np.testing.assert_allclose(forward[..., i], difference, rtol=0.03, atol=0.01 * scale)


@pytest.mark.parametrize("contact", [BekkerWongParams(), LUGGED_WHEEL])
def test_reversing_mirrors_driving(contact):
    soil = jax.tree.map(lambda x: x[0], SOILS)
    there = run(WHEEL, soil, contact, 0.04, 3.0, 0.5, 8.0)
    back = run(WHEEL, soil, contact, 0.04, -3.0, 0.5, -8.0)
    np.testing.assert_allclose(back.longitudinal, -there.longitudinal, rtol=1e-6)
    np.testing.assert_allclose(back.torque, -there.torque, rtol=1e-6)
    np.testing.assert_allclose([back.lateral, back.normal], [there.lateral, there.normal])
    assert there.lateral < 0 < there.longitudinal


def test_no_jump_from_braking_through_rolling_to_driving_and_none_at_rest():
    soil = jax.tree.map(lambda x: x[0], SOILS)
    omega = np.linspace(-1.0, 9.0, 2001)
    f = run(WHEEL, soil, BekkerWongParams(), 0.03, 2.0, 0.2, omega)
    for x in jax.tree.leaves(f):
        assert np.max(np.abs(np.diff(x))) < 0.02 * np.max(f.normal)

    speed = np.linspace(-0.1, 0.1, 2001)
    locked = run(WHEEL, soil, BekkerWongParams(), 0.03, speed, 0.0, 0.0)
    for x in jax.tree.leaves(locked):
        assert np.max(np.abs(np.diff(x))) < 0.02 * np.max(locked.normal)
    np.testing.assert_allclose(locked.longitudinal[1000], 0.0, atol=1e-2)
    assert np.all(locked.longitudinal * speed <= 1e-2)  # it resists, whichever way


def test_slip_is_defined_everywhere():
    v, w = np.float32([1, 2, 0, 0, 1, -1, -1]), np.float32([2, 1, 0, 1, 0, -2, 0])
    want = [0.5, -0.5, 0, 1, -1, 0.5, -1]

    def slip(v, w):
        return travel(Wheel(1.0, 1.0), 1e-4, (v, 0.0, w)).slip

    np.testing.assert_allclose(slip(v, w), want, atol=1e-6)
    gradient = jax.vmap(jax.grad(slip, (0, 1)))(v, w)
    assert np.isfinite(gradient).all()


def test_equilibrium_carries_the_load_and_differentiates_implicitly():
    load = np.float32([500.0, 6000.0, 3000.0])
    motion = (4.0, 0.2, 10.0)

    def sinkage(load, stiffness):
        soils = SOILS.replace(kphi=SOILS.kphi * stiffness)
        return equilibrium_sinkage(WHEEL, soils, BekkerWongParams(), load, motion)

    solve = jax.jit(sinkage)
    z = solve(load, 1.0)
    np.testing.assert_allclose(
        run(WHEEL, SOILS, BekkerWongParams(), z, *motion).normal, load, rtol=1e-3
    )
    np.testing.assert_allclose(solve(np.zeros(3), 1.0), 0, atol=1e-6)

    ones = np.ones(3, np.float32)
    forward = jax.jvp(lambda x: solve(x, 1.0), (load,), (ones,))[1]
    reverse = jax.grad(lambda x: solve(x, 1.0).sum())(load)
    difference = (solve(1.02 * load, 1.0) - solve(0.98 * load, 1.0)) / (0.04 * load)
    np.testing.assert_allclose(forward, reverse, rtol=1e-5)
    np.testing.assert_allclose(reverse, difference, rtol=0.01)
    stiffer = jax.grad(lambda x: solve(load, x).sum())(1.0)
    difference = (solve(load, 1.02) - solve(load, 0.98)).sum() / 0.04
    np.testing.assert_allclose(stiffer, difference, rtol=0.02)


def test_a_second_wheel_sinks_less_below_the_rut():
    motion = (4.0, 0.0, 10.0)
    contact = BekkerWongParams()
    first = equilibrium_sinkage(WHEEL, SOILS, contact, 3000.0, motion)
    second = equilibrium_sinkage(WHEEL, SOILS, contact, 3000.0, motion, rut=first)
    assert np.all(second > 0.9 * first) and np.all(second - first < 0.9 * first)
    # In deep snow compaction holds a wheel back, and less of it is left to do.
    pull = [
        run(WHEEL, SOILS, contact, *x).longitudinal
        for x in ((first, *motion), (second, *motion, first))
    ]
    assert pull[1][2] > pull[0][2]
    # Unloaded above the floor of the rut; the clay's, half a millimetre deep, is all elastic.
    assert not np.any(run(WHEEL, SOILS, contact, 0.5 * first, *motion, first).normal[::2])


def test_friction_on_rigid_ground_stays_inside_its_cone():
    key = np.random.default_rng(0)
    vx, vy, omega = key.normal(size=(3, 1000)) * [[5], [2], [10]]
    f = rigid_forces(WHEEL, 0.7, 6000.0, (vx, vy, omega))
    force = np.hypot(f.longitudinal, f.lateral)
    assert np.all(force <= 0.7 * 6000 * (1 + 1e-6)) and np.max(force) > 0.99 * 0.7 * 6000
    slip_x, slip_y = WHEEL.radius * omega - vx, -vy
    assert np.all(f.longitudinal * slip_x + f.lateral * slip_y >= 0)
    np.testing.assert_allclose(f.torque, WHEEL.radius * f.longitudinal)
    rest = rigid_forces(WHEEL, 0.7, np.float32([6000.0, -10.0]), (0.0, 0.0, 0.0))
    assert not np.any(rest.longitudinal) and rest.normal[1] == 0
    slope = jax.grad(lambda v: rigid_forces(WHEEL, 0.7, 6000.0, (v, v, 0.0)).longitudinal)(0.0)
    np.testing.assert_allclose(slope, -0.7 * 6000 / 0.05, rtol=1e-5)


def test_forces_in_a_soft_rut_are_finite_at_every_rounding() -> None:
    # A reloading stiffness below the soil's own puts the floor of the rut at the surface, where
    # one rounding error below zero had no power.
    key = jax.random.split(jax.random.key(0), 3)
    rut = jax.random.uniform(key[0], (200_000,), maxval=0.05)
    sinkage = jnp.abs(rut + 0.01 * jax.random.normal(key[1], rut.shape))
    speed = jax.random.uniform(key[2], rut.shape, maxval=5.0)
    contact = BekkerWongParams(unload_stiffness=1e6)
    wheel, soil = Wheel(radius=0.467, width=0.254), PRESETS["mud"]
    out = jax.jit(forces)(wheel, soil, contact, sinkage, speed, 0.1, 1.2 * speed / 0.467, rut)
    for name, values in vars(out).items():
        assert jnp.all(jnp.isfinite(values)), name


@pytest.mark.parametrize("name", ["sand", "heavy_clay_25", "snow_us"])
def test_a_wheel_ten_times_as_large_meets_soil_as_froude_says(name):
    second, creep = 10**0.5, 0.05
    small = run(
        Wheel(0.05, 0.04), PRESETS[name], BekkerWongParams(creep_speed=creep), 0.004, 0.3, 0.05, 8.0
    )
    contact, motion = (
        BekkerWongParams(creep_speed=second * creep),
        (second * 0.3, second * 0.05, 8 / second),
    )
    large = run(Wheel(0.5, 0.4), froude.scaled(PRESETS[name], 10.0), contact, 0.04, *motion)
    for field in ("longitudinal", "lateral", "normal", "torque"):
        factor = 1e4 if field == "torque" else 1e3
        found, expected = getattr(large, field), factor * getattr(small, field)
        np.testing.assert_allclose(found, expected, rtol=2e-3, err_msg=field)
