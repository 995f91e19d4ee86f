"""Newton-Euler equations of one rigid body under stiff contacts, solved linearly implicitly."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vertiwm_jax.mechanics.vector import Axes, Vector


class Twist(NamedTuple):
    """Velocity of the centre of mass (m/s) and angular velocity (rad/s), in body components."""

    linear: Vector
    angular: Vector


class ContactForce(NamedTuple):
    """Forces `[C]` along given directions at given points, and how they answer to motion.

    direction: unit vectors, body components `[C]`.
    arm: points of application relative to the centre of mass, m, body components `[C]`.
    force: N, at the current velocity.
    damping: N s/m, >= 0: force lost per velocity gained along the direction.
    """

    direction: Vector
    arm: Vector
    force: jax.Array
    damping: jax.Array


def velocity_at(twist: Twist, arm: Vector) -> Vector:
    """Velocity of body points `[C]` at `arm` from the centre of mass, m/s."""
    return twist.linear.plus(twist.angular.cross(arm))


def advance_twist(
    twist: Twist,
    mass: jax.Array,
    inertia: Vector,
    gravity: Vector,
    contacts: list[ContactForce],
    seconds: float,
) -> Twist:
    """The body's twist after one linearly implicit Euler step, in the axes it had before.

    (M + dt sum_c D_c J_c^T J_c) dv = dt (f + sum_c F_c J_c^T), with J_c = [d, r x d]: the damping
    of every contact acts on the new velocity, so stiff springs and sticking friction are stable
    at any step (Hairer and Wanner, Solving Ordinary Differential Equations II, sec. IV.7).

    inertia: principal moments about the centre of mass, kg m2; gravity: m/s2, body components.
    """
    diagonal = [mass, mass, mass, *inertia]
    zero = jnp.zeros_like(mass)
    rhs = [*gravity.times(mass), zero, zero, zero]
    matrix = [[diagonal[i] if i == j else zero for j in range(i + 1)] for i in range(6)]
    for contact in contacts:
        jacobian = (*contact.direction, *contact.arm.cross(contact.direction))
        for i in range(6):
            rhs[i] = rhs[i] + jnp.sum(contact.force * jacobian[i], axis=-1)
            weighted = seconds * contact.damping * jacobian[i]
            for j in range(i + 1):
                matrix[i][j] = matrix[i][j] + jnp.sum(weighted * jacobian[j], axis=-1)
    change = _solve_spd(matrix, [seconds * r for r in rhs])
    linear, angular = Vector(*change[:3]), Vector(*change[3:])
    return Twist(twist.linear.plus(linear), twist.angular.plus(angular))


def applied(contact: ContactForce, before: Twist, after: Twist) -> Vector:
    """Forces `[C]` that took the twist from `before` to `after`, N, in the axes it had before."""
    gained = velocity_at(after, contact.arm).plus(velocity_at(before, contact.arm), -1.0)
    lost = contact.damping * gained.dot(contact.direction)
    return contact.direction.times(contact.force - lost)


def turned(twist: Twist, inertia: Vector, turn: Axes) -> Twist:
    """A free body's twist in its axes after they have turned by `turn`.

    Linear and angular momentum keep their length exactly, which the explicit gyroscopic terms
    -w x v and -w x I w do not: those blow up a tumbling body.
    """
    w = twist.angular
    momentum = turn.to_body(Vector(inertia.x * w.x, inertia.y * w.y, inertia.z * w.z))
    angular = Vector(momentum.x / inertia.x, momentum.y / inertia.y, momentum.z / inertia.z)
    return Twist(turn.to_body(twist.linear), angular)


def _solve_spd(lower: list[list[jax.Array]], rhs: list[jax.Array]) -> list[jax.Array]:
    """Cholesky solution, written out so that XLA fuses it over a batch of small systems."""
    n = len(rhs)
    factor: list[list[jax.Array]] = []
    for i in range(n):
        row: list[jax.Array] = []
        for j in range(i + 1):
            rest = lower[i][j]
            for k in range(j):
                rest = rest - row[k] * (row[k] if i == j else factor[j][k])
            # The diagonal is kept as its reciprocal: it is only ever divided by.
            row.append(jax.lax.rsqrt(rest) if i == j else rest * factor[j][j])
        factor.append(row)
    forward: list[jax.Array] = []
    for i in range(n):
        rest = rhs[i]
        for k in range(i):
            rest = rest - factor[i][k] * forward[k]
        forward.append(rest * factor[i][i])
    solution = forward
    for i in reversed(range(n)):
        rest = forward[i]
        for k in range(i + 1, n):
            rest = rest - factor[k][i] * solution[k]
        solution[i] = rest * factor[i][i]
    return solution
