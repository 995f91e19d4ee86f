"""Estimates soils while driving, where the map has them wrong; the model's weights are frozen.

A buffered extended Kalman filter: it predicts the last seconds of the drive again, with the soils
that it believes in now. Where the vehicle really went corrects them.
"""

from dataclasses import replace
from typing import Annotated, Any, TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jax.scipy.special import logit

from vertiwm_jax.adaptation import kalman
from vertiwm_jax.adaptation.kalman import Gaussian
from vertiwm_jax.config import Bounds, Count, CountOrZero, Positive, settings
from vertiwm_jax.dynamics import Dynamics, Params, rollout, warm_up
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.soil import from_unit, to_unit
from vertiwm_jax.world_model import motion
from vertiwm_jax.world_model.nesam import Nesam

T = TypeVar("T")
Six = tuple[Positive, Positive, Positive, Positive, Positive, Positive]
MARGIN = 0.05
"""Least distance of initial parameters from either end of `BOUNDS`, as a share of these.

At the ends, the derivatives of all that depends on a logit are 0.
"""
LONGEST_STEP = 1.0
"""Largest step of an iteration, in logits: sinkage is far from linear in the moduli."""


@struct.dataclass
class SoilBelief:
    """A belief about K soils, and a buffer of the last C + H steps of the drive.

    soils: leaves `[K, 6]` and `[K, 6, 6]`, logits of where in `BOUNDS` each parameter lies; rows
        of rigid classes are never used but finite.
    states: `[C + H + 1, 12]`, the newest last. commands: `[C + H, 2]`, those between them.
    steps: `[]` int32, of the drive so far; with 0 another drive begins.
    accepted, refused: `[K]` int32, measurements of each class so far.
    """

    soils: Gaussian
    states: jax.Array
    commands: jax.Array
    steps: jax.Array
    accepted: jax.Array
    refused: jax.Array


@settings
class SoilFilter:
    """Estimates the six parameters of `BOUNDS` of each class of soil from how the vehicle moves.

    A measurement is the pose increment of H steps in the body frame, predicted after a history of
    C steps before them. It counts if the vehicle is on the same class in all of the H steps.
    Parameters that are not measured for long return to what the map says.
    """

    context: CountOrZero = 8
    """Recorded steps that the model sees first, C."""
    horizon: Count = 8
    """Steps that it then predicts, H."""
    prior: Positive = 1.5
    """Standard deviation of what the map says, in logits."""
    memory: Annotated[float, Bounds("more than 0 and at most 1", lambda x: 0 < x <= 1)] = 0.98
    """Share of the deviation from the map that remains at the next measurement. The rest is
    forgotten, and the uncertainty grows accordingly."""
    noise: Six = (0.05, 0.05, 0.02, 0.02, 0.02, 0.02)
    """Standard deviations of what the model misses in H steps with the right soil: ahead, to the
    left and up, m, and about these axes, rad."""
    gate: Positive = 22.5
    """Largest squared Mahalanobis distance of a measurement that counts; 22.5 is 99.9 % of
    chi-square with six degrees of freedom."""
    iterations: Count = 3
    """Gauss-Newton steps of a measurement; 1 is the extended filter."""

    def init(self, terrain: TerrainMap, state: VehicleState) -> SoilBelief:
        """The belief at the start of a drive: the soils of the map."""
        soils, steps = self._of_map(terrain), self.context + self.horizon
        none = jnp.zeros(len(soils.mean), jnp.int32)
        return SoilBelief(
            soils=soils,
            states=jnp.broadcast_to(state.vector, (steps + 1, 12)),
            commands=jnp.zeros((steps, 2)),
            steps=jnp.int32(0),
            accepted=none,
            refused=none,
        )

    def update(
        self,
        model: Dynamics,
        params: Params,
        terrain: TerrainMap,
        belief: SoilBelief,
        state: VehicleState,
        command: Command,
    ) -> SoilBelief:
        """Updates the belief after one more step of 0.1 s, in which `command` led to `state`.

        Every H steps it measures. Under `vmap`, which computes both sides of a condition, calling
        `record` and `measure` separately is cheaper. Raises like `measure`.
        """
        belief = self.record(belief, state, command)
        return jax.lax.cond(
            belief.steps % self.horizon == 0,
            lambda: self.measure(model, params, terrain, belief),
            lambda: belief,
        )

    def record(self, belief: SoilBelief, state: VehicleState, command: Command) -> SoilBelief:
        """Puts one more step into the buffer."""
        return replace(
            belief,
            states=jnp.concatenate([belief.states[1:], state.vector[None]]),
            commands=jnp.concatenate([belief.commands[1:], command.vector[None]]),
            steps=belief.steps + 1,
        )

    def measure(
        self, model: Dynamics, params: Params, terrain: TerrainMap, belief: SoilBelief
    ) -> SoilBelief:
        """Corrects the belief by the last H recorded steps, once the drive has C + H steps.

        To measure more often than every H steps would count steps twice.

        Args:
            model, params: the model that predicts.
            terrain: the map as it was; only its soils are in doubt.
            belief: what is believed before.

        Raises:
            ValueError: the model does not take soils from the map, or its gradients are not exact.
        """
        _check(model, params)
        c = self.context
        states = VehicleState.from_vector(belief.states)
        commands = Command.from_vector(belief.commands)
        before, after = _at(commands, slice(c)), _at(commands, slice(c, None))
        known, start, end = (_at(states, place) for place in (slice(c + 1), c, -1))
        kinds = query.surface(terrain, states.position[c:, :2]).semantic
        kind = kinds[-1]
        aged = self._aged(terrain, belief.soils)

        def residual(mean: jax.Array) -> jax.Array:
            """`[6]` recorded minus predicted pose at the end of the buffer, over the noise."""
            soils = replace(aged, mean=aged.mean.at[kind].set(mean))
            ground = believed(terrain, replace(belief, soils=soils))
            history = warm_up(model, params, ground, known, before)
            predicted = rollout(model, params, ground, start, after, history)
            return motion.increment(_at(predicted, -1), end) / jnp.asarray(self.noise)

        posterior, plausible = kalman.correct(
            _at(aged, kind), residual, self.gate, self.iterations, LONGEST_STEP
        )
        full = belief.steps >= self.context + self.horizon
        counts = full & terrain.deformable[kind] & jnp.all(kinds == kind)
        corrected = jax.tree.map(lambda x, y: x.at[kind].set(y), aged, posterior)
        return replace(
            belief,
            soils=jax.tree.map(lambda x, y: jnp.where(counts, x, y), corrected, aged),
            accepted=belief.accepted.at[kind].add((counts & plausible).astype(jnp.int32)),
            refused=belief.refused.at[kind].add((counts & ~plausible).astype(jnp.int32)),
        )

    def _of_map(self, terrain: TerrainMap) -> Gaussian:
        """What the map says, leaves `[K, 6]` and `[K, 6, 6]`."""
        mean = logit(jnp.clip(to_unit(query.soils(terrain)), MARGIN, 1 - MARGIN))
        one = self.prior**2 * jnp.eye(mean.shape[1])
        return Gaussian(mean, jnp.broadcast_to(one, (*mean.shape, mean.shape[1])))

    def _aged(self, terrain: TerrainMap, soils: Gaussian) -> Gaussian:
        """The belief at the next measurement, by a process that returns to the map."""
        prior, kept = self._of_map(terrain), self.memory
        mean = prior.mean + kept * (soils.mean - prior.mean)
        covariance = prior.covariance + kept**2 * (soils.covariance - prior.covariance)
        return Gaussian(mean, covariance)


def believed(terrain: TerrainMap, belief: SoilBelief) -> TerrainMap:
    """The map with the soils of a belief, for a model to drive on."""
    unit_weight = query.soils(terrain).unit_weight
    return terrain.with_soils(from_unit(jax.nn.sigmoid(belief.soils.mean), unit_weight))


def _at(tree: T, place: Any) -> T:
    return jax.tree.map(lambda x: x[place], tree)


def _check(model: Dynamics, params: Params) -> None:
    """Raises `ValueError` for a model without exact derivatives by the soils of the map."""
    nesam = getattr(model, "nesam", getattr(model, "specialist", None))
    if isinstance(nesam, Nesam) and nesam.gradient != "exact":
        raise ValueError(
            "model: expected one of load_model(exact_gradient=True) to adapt soils, found one "
            "without exact gradients"
        )
    encoders = getattr(params, "encoders", ())
    if encoders and encoders[-1].soil is not None:
        raise ValueError("soil: expected 'map' to adapt the soils of the map, found 'predicted'")
