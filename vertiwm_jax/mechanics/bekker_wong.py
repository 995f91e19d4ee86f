"""The wheel in soil by Bekker and Wong: angles, normal stress, shear and bulldozing, summed up.

Angles are from the downward vertical, positive toward the direction of travel. The soil is
entered at th1, stressed most at thm, left at th2; where the wheel skids the flow of soil under
it reverses at th0. Everything is elementwise over any axes `[...]`.

Sources: Bekker, Introduction to Terrain-Vehicle Systems (1969); Wong and Reece, J. Terramechanics
4(1) and 4(2) (1967); Janosi and Hanamoto (1961); Ishigami et al., J. Field Robotics 24 (2007);
Wong, Theory of Ground Vehicles, 4th ed. (2008), ch. 2; Pavlov and Johnson, J. Terramechanics
(2024).
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vertiwm_jax.mechanics.wheel import (
    Arrays,
    Float,
    Motion,
    Wheel,
    WheelForces,
    broadcast,
    contact_angle,
    depth_below,
    integrated,
    sin_cos,
)
from vertiwm_jax.terrain.soil import Soil

PANELS = 5
"""Pieces of the contact within which the stresses are smooth; see `breaks`."""

_MAX_PEAK = 0.98  # of th1; the peak stays inside the contact


@struct.dataclass
class Ploughing:
    """What sliding does to the contact `[...]`; coefficients are dimensionless.

    s is the slip of the rim against the hub's whole speed V, positive when driven: 1 - V/(r w)
    driven, r w/V - 1 braked. vx and vy are the hub's velocity along and across the wheel.

    soft_aside, soft_slip, soft_skid: Bekker's pressure is divided by 1 + soft_aside
        |vy| / (vx^2 + (forward V)^2)^1/2 + soft_slip s driven + soft_skid s^2 |vx| / V braked:
        soil yields the more, the farther it is sheared while the wheel passes over it.
    peak_aside, peak_skid: added to thm: peak_aside |vy| / max(V, r w) of th1, and braked
        - peak_skid s |vx| / V of sin th1; peak_slip takes this s too.
    forward: share of V along the wheel below which ahead and behind become alike: thm tends to
        0 and th2 to -th1 where a wheel slides straight to its side.
    side, side_slip: the passive pressure of the soil columns along the flank, on its height under
        the undisturbed surface, times side (1 - side_slip s) driven.
    """

    soft_aside: Float
    soft_slip: Float
    soft_skid: Float
    peak_aside: Float
    peak_skid: Float
    forward: Float
    side: Float
    side_slip: Float


@struct.dataclass
class BekkerWongParams:
    """Empirical coefficients of wheel-soil contact `[...]`; s is slip, positive when driven.

    peak, peak_slip: thm = (peak + peak_slip max(s, 0)) th1.
    exit, exit_slip: th2 = (exit + exit_slip max(s, 0)) th1.
    rebound: lam of th2 = -acos(1 - lam h / r), added to the former (Ishigami 2007).
    slip_sinkage, skid_sinkage: n = n0 + slip_sinkage s driven, n0 - skid_sinkage s braked.
    unload_stiffness: k0 in Pa/m of Wong's unloading and reloading p = p_u - k0 (z_u - z); stiff
        enough to be felt in a rut only.
    creep_speed: m/s below which shear fades out, so that a standing wheel has smooth forces.
    ploughing: of a wheel that slides far, also sideways; without it the contact is that of the
        other coefficients alone. It has a side pressure of its own in place of `bulldozing`.
    bulldozing: pressure on the wheel's side, "ishigami" (2007) or "wong" (2008).
    nodes: of Gauss-Legendre's rule in each of the five pieces of the contact.
    """

    peak: Float = 0.4
    peak_slip: Float = 0.15
    exit: Float = 0.0
    exit_slip: Float = 0.0
    rebound: Float = 0.0
    slip_sinkage: Float = 0.0
    skid_sinkage: Float = 0.0
    unload_stiffness: Float = 2e8
    creep_speed: Float = 0.05
    ploughing: Ploughing | None = None
    bulldozing: Literal["ishigami", "wong"] = struct.field(pytree_node=False, default="ishigami")
    nodes: int = struct.field(pytree_node=False, default=6)

    def forces(
        self, wheel: Wheel, soil: Soil, sinkage: Float, motion: Motion, rut: Float = 0.0
    ) -> WheelForces:
        """As `SoilContact.forces`, continuous through every regime.

        Six nodes in each of five pieces are within 0.1 % (99 % of random wheels, soils and
        motions). Driven, braked, towed, reversing and standing wheels are one formula; values and
        gradients are finite for any finite state. Only a wheel that spins against its travel as
        fast as it travels jumps, when the direction in which it enters the soil changes.
        """
        shape, given = broadcast((self, wheel, soil, sinkage, motion, rut))
        contact, wheel, soil, sinkage, motion, rut = given

        m = travel(wheel, contact.creep_speed, motion)
        n = soil.n + contact.slip_sinkage * jnp.maximum(m.slip, 0.0)
        n = n + contact.skid_sinkage * jnp.maximum(-m.slip, 0.0)
        keq = (soil.kc / wheel.width + soil.kphi) * bearing(contact, m)
        floor, unload = reloading(contact, keq, n, rut)

        depth, touching = depth_below(floor, sinkage, wheel)
        p = patch(contact, depth, m)
        starts = jnp.stack(breaks(p, m))
        extents = jnp.diff(starts, axis=0)

        def stresses(
            panel: jax.Array, point: jax.Array, weight: jax.Array
        ) -> tuple[jax.Array, Arrays]:
            extent = extents[panel]
            angle = starts[panel] + point * extent
            at = Arc(angle, *sin_cos(angle))
            z = wheel.radius * pressing_depth(p, at.angle)
            sigma = normal_stress(keq, n, unload, floor, z)
            tau_x, tau_y = shear_stress(soil, contact, p, m, at, sigma)
            side = bulldozing(soil, contact, wheel.radius, p, m, at)
            found = (
                tau_x * at.cos - m.rolling * sigma * at.sin,
                wheel.width * tau_y + side,
                sigma * at.cos + m.rolling * tau_x * at.sin,
                tau_x,
            )
            return weight * extent, found

        total = integrated(stresses, _quadrature(self.nodes), shape)
        longitudinal, lateral, normal, torque = (jnp.where(touching, t, 0.0) for t in total)
        area = wheel.radius * wheel.width
        return WheelForces(
            longitudinal=m.ahead * area * longitudinal,
            lateral=wheel.radius * lateral,
            normal=area * normal,
            torque=m.ahead * area * wheel.radius * torque,
        )


COMPACT_SAND = BekkerWongParams(peak=0.43, peak_slip=0.32)
"""Wong and Reece (1967)."""
LOOSE_SAND = BekkerWongParams(peak=0.18, peak_slip=0.32)
"""Wong and Reece (1967)."""
SMOOTH_WHEEL = BekkerWongParams(
    peak=0.245,
    peak_slip=-0.122,
    exit=-0.230,
    ploughing=Ploughing(
        soft_aside=2.27,
        soft_slip=3.98,
        soft_skid=3.66,
        peak_aside=0.256,
        peak_skid=0.639,
        forward=0.0402,
        side=1.71,
        side_slip=0.399,
    ),
)
"""A smooth wheel, in the soil "sand_smooth_wheel": fitted to trials at slip angles of 0 to 90
degrees and slips of -1 to 0.9 (Pavlov and Johnson 2024) by `benchmarks.measured_wheels`. Wheels as
slow as theirs (0.01 m/s) need a `creep_speed` far below their speed."""
LUGGED_WHEEL = BekkerWongParams(
    peak=0.276,
    peak_slip=-0.325,
    exit=-0.260,
    ploughing=Ploughing(
        soft_aside=2.35,
        soft_slip=7.50,
        soft_skid=3.38,
        peak_aside=0.253,
        peak_skid=0.498,
        forward=0.0356,
        side=1.74,
        side_slip=-0.0736,
    ),
)
"""The same with lugs of 5 mm, in "sand_lugged_wheel". The radius ends at half their height."""


class Travel(NamedTuple):
    """A wheel's motion seen along its travel, so that the soil is always entered ahead.

    ahead: 1 forwards, -1 in reverse. hub, rim: m/s along the travel. lateral: m/s to the left.
    spin: |omega| in rad/s, never zero. rolling: 1, fading to 0 at rest, where "ahead" has no
    meaning. slip: in [-1, 1], 1 - v/(r w) driven, r w/v - 1 braked, zero at rest.
    """

    ahead: jax.Array
    hub: jax.Array
    rim: jax.Array
    lateral: jax.Array
    spin: jax.Array
    rolling: jax.Array
    slip: jax.Array


class Sliding(NamedTuple):
    """The same motion beside the hub's whole speed: what `Ploughing` is a function of.

    driven, braked: slip of the rim against the whole speed, both in [0, 1]. along, aside: shares
    of the whole speed along and across the wheel. sweep: m across per m along, bounded.
    forward: 1, fading to 0 where the hub moves across the wheel alone. lateral: across, as a
    share of the faster of rim and hub.
    """

    driven: jax.Array
    braked: jax.Array
    along: jax.Array
    sweep: jax.Array
    forward: jax.Array
    lateral: jax.Array


class Patch(NamedTuple):
    """Angles of the contact, rad: th1, thm, th2 and th0."""

    entry: jax.Array
    peak: jax.Array
    exit: jax.Array
    reversal: jax.Array


class Arc(NamedTuple):
    """Points of the rim: angles with their sines and cosines."""

    angle: jax.Array
    sin: jax.Array
    cos: jax.Array


def travel(wheel: Wheel, creep_speed: Float, motion: Motion) -> Travel:
    """The motion of a wheel `[...]`; values and gradients are finite everywhere."""
    velocity_x, velocity_y, omega = motion
    rim = wheel.radius * omega
    both = velocity_x + rim
    ahead = jnp.where(both >= 0, 1.0, -1.0)
    faster = jnp.maximum(jnp.square(velocity_x), jnp.square(rim))
    slip = ahead * (rim - velocity_x) * jax.lax.rsqrt(faster + jnp.square(creep_speed))
    return Travel(
        ahead=ahead,
        hub=ahead * velocity_x,
        rim=ahead * rim,
        lateral=jnp.asarray(velocity_y),
        spin=jnp.sqrt(jnp.square(omega) + (creep_speed / wheel.radius) ** 2),
        rolling=jnp.abs(both) * jax.lax.rsqrt(both**2 + creep_speed**2),
        slip=jnp.clip(slip, -1.0, 1.0),
    )


def sliding(ploughing: Ploughing, creep_speed: Float, m: Travel) -> Sliding:
    """Slips `[...]` beside the whole speed; values and gradients are finite everywhere."""
    squared = jnp.square(m.hub) + jnp.square(m.lateral) + jnp.square(creep_speed)
    speed = jnp.sqrt(squared)
    faster = jnp.maximum(speed, jnp.abs(m.rim))
    slip = (m.rim - speed) / faster
    ahead = jax.lax.rsqrt(jnp.square(m.hub) + squared * jnp.square(ploughing.forward))
    across = jnp.abs(m.lateral)
    return Sliding(
        driven=jnp.maximum(slip, 0.0),
        braked=jnp.clip(-slip, 0.0, 1.0),
        along=jnp.abs(m.hub) / speed,
        sweep=across * ahead,
        forward=jnp.abs(m.hub) * ahead,
        lateral=across / faster,
    )


def bearing(contact: BekkerWongParams, m: Travel) -> Float:
    """Share of Bekker's moduli that soil keeps under a wheel that slides."""
    if contact.ploughing is None:
        return 1.0
    q, a = contact.ploughing, sliding(contact.ploughing, contact.creep_speed, m)
    softer = q.soft_aside * a.sweep + q.soft_skid * jnp.square(a.braked) * a.along
    return 1 / (1 + softer + q.soft_slip * a.driven)


def patch(contact: BekkerWongParams, depth: jax.Array, m: Travel) -> Patch:
    """Where a wheel touches soil at `depth`, in wheel radii."""
    driven, braked = jnp.maximum(m.slip, 0.0), jnp.maximum(-m.slip, 0.0)
    entry = contact_angle(depth)
    # Pavlov (2024): continuous from driving to braking.
    reversal = (1 - braked / 2) * entry
    rebound = contact_angle(contact.rebound * depth)
    ploughing = contact.ploughing
    if ploughing is None:
        peak = (contact.peak + contact.peak_slip * driven) * entry
        peak = jnp.minimum(peak, _MAX_PEAK * entry)
        leave = (contact.exit + contact.exit_slip * driven) * entry - rebound
    else:
        a = sliding(ploughing, contact.creep_speed, m)
        peak = contact.peak + contact.peak_slip * a.driven + ploughing.peak_aside * a.lateral
        # By the sine: a locked wheel that sinks deep still stands on what is below it.
        peak = peak * entry + ploughing.peak_skid * a.braked * a.along * jnp.sin(entry)
        peak = a.forward * jnp.clip(peak, 0.0, _MAX_PEAK * entry)
        leave = (contact.exit + contact.exit_slip * a.driven) * entry - rebound
        leave = a.forward * leave - (1 - a.forward) * entry
    return Patch(entry, peak, jnp.minimum(leave, peak), reversal)


def breaks(p: Patch, m: Travel) -> tuple[jax.Array, ...]:
    """Angles from exit to entry, `PANELS + 1` of them, between which the stresses are smooth.

    Beside the peak they are, under a skidding wheel, the reversal of the flow of soil and the
    points ahead of it and behind it where the slip velocity changes sign. A driven wheel has
    none of these: they collapse on its peak.
    """
    mean = _mean_cosine(p)
    skid = m.slip < 0
    ratio = jnp.clip(jnp.where(skid, m.rim / jnp.where(skid, m.hub, 1.0), 0.5), -0.999, 0.999)
    still_rear = jnp.clip(jnp.arccos(ratio), p.exit, p.reversal)
    still_front = jnp.clip(contact_angle(1 - mean), p.reversal, p.entry)
    low, middle, high = (jnp.where(skid, x, p.peak) for x in (still_rear, p.reversal, still_front))
    return (
        p.exit,
        jnp.minimum(low, p.peak),
        jnp.clip(p.peak, low, middle),
        jnp.clip(p.peak, middle, high),
        jnp.maximum(high, p.peak),
        p.entry,
    )


def _mean_cosine(p: Patch) -> jax.Array:
    """Mean cosine between reversal and entry, Wong and Reece's (1 + Kv (1 + i))/(1 + i)."""
    # Written as a sinc it stays exact when the arc vanishes.
    half = (p.entry - p.reversal) / 2
    return jnp.cos((p.entry + p.reversal) / 2) * jnp.sinc(half / jnp.pi)


def pressing_depth(p: Patch, angle: jax.Array) -> jax.Array:
    """Depth in radii whose pressure acts at `angle`: cos th - cos th1, mirrored behind thm."""
    behind = p.peak - p.exit
    some = behind > 0
    scale = jnp.where(some, (p.entry - p.peak) / jnp.where(some, behind, 1.0), 0.0)
    from_entry = jnp.where(angle < p.peak, (angle - p.exit) * scale, p.entry - angle)
    # Half angles, because the difference of two cosines is lost in rounding near the entry.
    sin_a, cos_a = sin_cos(from_entry / 2)
    return 2 * sin_a * (jnp.sin(p.entry) * cos_a - jnp.cos(p.entry) * sin_a)


def reloading(
    contact: BekkerWongParams, keq: Float, n: Float, rut: Float
) -> tuple[jax.Array, jax.Array]:
    """Depth in m of the floor of a rut after its elastic rebound, and its stiffness in Pa/m.

    rut: m deep while loaded; soil at 0 was never loaded and yields at once.
    """
    compacted = rut > 0
    deepest = jnp.where(compacted, rut, 1.0)
    pressure = keq * jnp.exp(n * jnp.log(deepest))
    # Rebound never lifts the floor above the undisturbed surface.
    stiffness = jnp.maximum(contact.unload_stiffness, pressure / deepest)
    # Rounding must not lift it either: a negative depth has no power.
    floor = jnp.where(compacted, jnp.maximum(deepest - pressure / stiffness, 0.0), 0.0)
    return floor, jnp.where(compacted, stiffness, 1e15)


def normal_stress(keq: Float, n: Float, unload: Float, floor: jax.Array, z: jax.Array) -> jax.Array:
    """Bekker's pressure in Pa, `z` m below the floor of the rut, never above elastic reloading."""
    # The clip keeps the slope of z^n finite where n < 1.
    z = jnp.maximum(z, 1e-9)
    return jnp.minimum(keq * jnp.exp(n * jnp.log(floor + z)), unload * z)


def shear_stress(
    soil: Soil, contact: BekkerWongParams, p: Patch, m: Travel, at: Arc, sigma: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Janosi-Hanamoto shear in Pa on the wheel: along the rim, forwards, and to the left."""
    mean = _mean_cosine(p)  # ahead of th0 the soil is pushed along with it
    pushed = at.angle > p.reversal
    # Displacements times the spin: finite when the wheel locks.
    path_x = jnp.where(
        pushed,
        m.hub * (mean * (p.entry - at.angle) - (jnp.sin(p.entry) - at.sin)),
        m.rim * (p.reversal - at.angle) - m.hub * (jnp.sin(p.reversal) - at.sin),
    )
    path_y = m.lateral * (at.angle - p.entry)
    creep = contact.creep_speed
    path = jnp.sqrt(path_x**2 + path_y**2 + (1e-3 * creep) ** 2)
    strength = soil.cohesion + sigma * jnp.tan(soil.friction_angle)
    tau = strength * (1 - jnp.exp(-path / (soil.shear_modulus * m.spin)))
    along = jnp.where(pushed, m.hub * (mean - at.cos), m.rim - m.hub * at.cos)
    across = -m.lateral
    tau = tau * jax.lax.rsqrt(along**2 + across**2 + creep**2)
    return tau * along, tau * across


def bulldozing(
    soil: Soil, contact: BekkerWongParams, radius: Float, p: Patch, m: Travel, at: Arc
) -> jax.Array:
    """Side force per angle and wheel radius, N/(rad m), of the soil the wheel's flank pushes."""
    sin_slip_angle = -m.lateral * jax.lax.rsqrt(m.hub**2 + m.lateral**2 + contact.creep_speed**2)
    tangent = jnp.tan(soil.friction_angle)
    cotangent = jnp.tan(jnp.pi / 4 + soil.friction_angle / 2)  # of Xc; equals tan(Xc + phi)
    if contact.ploughing is not None or contact.bulldozing == "ishigami":
        below = radius * jnp.maximum(at.cos - jnp.cos(p.entry), 0.0)
        d2 = cotangent + cotangent**2 * tangent
        pressure = 2 * cotangent * below * (soil.cohesion + d2 * soil.unit_weight * below / 2)
        if contact.ploughing is None:
            return pressure * (1 - below * at.cos / radius) * sin_slip_angle
        driven = sliding(contact.ploughing, contact.creep_speed, m).driven
        share = contact.ploughing.side * (1 - contact.ploughing.side_slip * driven)
        return share * pressure * jnp.maximum(at.cos, 0.0) * sin_slip_angle
    # Wong: the pressed soil fills the segment under the chord from exit to entry.
    share = (at.sin - jnp.sin(p.exit)) / (jnp.sin(p.entry) - jnp.sin(p.exit))
    chord = share * (jnp.cos(p.exit) - jnp.cos(p.entry))
    height = radius * jnp.clip(chord - jnp.cos(p.exit) + at.cos, 0.0, 2 * jnp.abs(at.cos))
    pressure = soil.unit_weight / 2 * (height * cotangent) ** 2 * (1 + cotangent * tangent / 2)
    pressure = pressure + 2 * height * soil.cohesion * cotangent
    return pressure * at.cos * sin_slip_angle * jnp.abs(sin_slip_angle)


def _quadrature(nodes: int) -> Arrays:
    """Panel, Gauss-Legendre point and weight on [0, 1] of every node, `[panels * nodes]`.

    Crowded by a square toward the exit in the first panel and the entry in the last, where
    stress grows like a power and shear like an exponential of the distance, by a cubic toward
    both ends of those between, where shear reverses.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = (x + 1) / 2, w / 2
    middle = (x**2 * (3 - 2 * x), 6 * x * (1 - x) * w)
    panels = [(x**2, 2 * x * w), *[middle] * (PANELS - 2), (1 - x**2, 2 * x * w)]
    points, weights = np.concatenate(panels, axis=1, dtype=np.float32)
    panel = jnp.repeat(jnp.arange(PANELS), nodes)
    return panel, jnp.asarray(points), jnp.asarray(weights)
