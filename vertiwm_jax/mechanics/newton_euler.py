"""Newton-Euler equations of one rigid body under stiff contacts, solved linearly implicitly."""

from typing import NamedTuple, Self

import jax
import jax.numpy as jnp

from vertiwm_jax.vector import Axes, Vector, sum_of


class Twist(NamedTuple):
    """Velocity of the center of mass (m/s) and angular velocity (rad/s), in body components."""

    linear: Vector
    angular: Vector


class DampedForce(NamedTuple):
    """Forces `[C]` along unit vectors, and how they answer to motion.

    direction: body components. force: N, at the current velocity.
    damping: N s/m, >= 0: force lost per velocity gained along the direction.
    """

    direction: Vector
    force: jax.Array
    damping: jax.Array


class ContactForce(NamedTuple):
    """All that acts on points `[C]` of the body, in its components.

    arm: of the points from the center of mass, m. force: N, at the current velocity.
    damping: N s/m, rows of a symmetric matrix: force lost per velocity gained.
    """

    arm: Vector
    force: Vector
    damping: tuple[Vector, Vector, Vector]

    @classmethod
    def of(cls, arm: Vector, *forces: DampedForce) -> Self:
        """Several forces on the same points."""
        weighted = [force.direction.times(force.damping) for force in forces]
        x, y, z = (
            sum_of(w.times(force.direction[i]) for w, force in zip(weighted, forces, strict=True))
            for i in range(3)
        )
        return cls(arm, sum_of(force.direction.times(force.force) for force in forces), (x, y, z))


class Shaft(NamedTuple):
    """A spin that wheels `[C]` have in common; vectors are body components.

    arm: of their contacts from the center of mass, m. pull: N s/rad, force on each contact per spin
    gained, and torque about the shaft per velocity gained. inertia: `[]` kg m2 against which these
    torques act within a step.
    """

    arm: Vector
    pull: Vector
    inertia: jax.Array

    def gained(self, before: Twist, after: Twist, seconds: float) -> jax.Array:
        """`[]` rad/s of spin, from the velocity that the contacts have gained."""
        gained = velocity_at(after, self.arm).plus(velocity_at(before, self.arm), -1.0)
        return seconds * jnp.sum(self.pull.dot(gained)) / self.inertia


def velocity_at(twist: Twist, arm: Vector) -> Vector:
    """Velocity of body points `[C]` at `arm` from the center of mass, m/s."""
    return twist.linear.plus(twist.angular.cross(arm))


def advance_twist(
    twist: Twist,
    mass: jax.Array,
    inertia: Vector,
    gravity: Vector,
    contacts: list[ContactForce],
    seconds: float,
    shaft: Shaft | None = None,
) -> Twist:
    """The body's twist after one linearly implicit Euler step, in the axes it had before.

    (M + dt sum_c J_c^T D_c J_c) dv = dt (f + sum_c J_c^T F_c), with J_c = [1, -r x]: the damping
    of every contact acts on the new velocity, so stiff springs and sticking friction are stable
    at any step (Hairer and Wanner, Solving Ordinary Differential Equations II, sec. IV.7). What a
    shaft gains is eliminated: a matrix of rank one, sum_c J_c^T pull_c times itself, less.

    inertia: principal moments about the center of mass, kg m2; gravity: m/s2, body components.
    """
    diagonal = [mass, mass, mass, *inertia]
    zero = jnp.zeros_like(mass)
    rhs = [*gravity.times(mass), zero, zero, zero]
    matrix = [[diagonal[i] if i == j else zero for j in range(i + 1)] for i in range(6)]
    for contact in contacts:
        push = (*contact.force, *contact.arm.cross(contact.force))
        # D, D (-r x) by rows, and (r x) of that by columns: all of the lower triangle.
        mixed = [contact.arm.cross(row) for row in contact.damping]
        angular = [contact.arm.cross(Vector(*column)) for column in zip(*mixed, strict=True)]
        for i in range(6):
            rhs[i] = rhs[i] + jnp.sum(push[i], axis=-1)
            for j in range(i + 1):
                if i < 3:
                    damping = contact.damping[j][i]
                else:
                    damping = mixed[j][i - 3] if j < 3 else angular[j - 3][i - 3]
                matrix[i][j] = matrix[i][j] + seconds * jnp.sum(damping, axis=-1)
    if shaft is not None:
        pulls = [jnp.sum(x, axis=-1) for x in (*shaft.pull, *shaft.arm.cross(shaft.pull))]
        for i in range(6):
            for j in range(i + 1):
                gained = seconds**2 * pulls[i] * pulls[j] / shaft.inertia
                matrix[i][j] = matrix[i][j] - gained
    change = _solve_spd(matrix, [seconds * r for r in rhs])
    linear, angular = Vector(*change[:3]), Vector(*change[3:])
    return Twist(twist.linear.plus(linear), twist.angular.plus(angular))


def applied(contact: ContactForce, before: Twist, after: Twist) -> Vector:
    """Forces `[C]` that took the twist from `before` to `after`, N, in the axes it had before."""
    gained = velocity_at(after, contact.arm).plus(velocity_at(before, contact.arm), -1.0)
    lost = Vector(*(row.dot(gained) for row in contact.damping))
    return contact.force.plus(lost, -1.0)


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
    factor: list[list[jax.Array]] = []
    # The right-hand side as one more row is eliminated with the others.
    for i, line in enumerate([*lower, rhs]):
        row: list[jax.Array] = []
        for j, rest in enumerate(line):
            for k in range(j):
                rest = rest - row[k] * (row[k] if i == j else factor[j][k])
            # The diagonal is kept as its reciprocal: it is only ever divided by.
            row.append(jax.lax.rsqrt(rest) if i == j else rest * factor[j][j])
        factor.append(row)
    solution = factor.pop()
    for i in reversed(range(len(rhs))):
        rest = solution[i]
        for k in range(i + 1, len(rhs)):
            rest = rest - factor[k][i] * solution[k]
        solution[i] = rest * factor[i][i]
    return solution
