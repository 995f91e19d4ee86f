"""Domain randomization: episodes with other ground and later commands than the policy expects.

A policy that has trained with weaker soil, less grip and late commands relies less on
errors of its model (Peng et al., 2018, "Sim-to-real transfer with dynamics randomization").
"""

import dataclasses
from typing import Annotated, Self

import jax
import jax.numpy as jnp
from flax import struct

from vertiwm_jax.config import Bounds, CountOrZero, settings
from vertiwm_jax.terrain import query
from vertiwm_jax.terrain.map import TerrainMap

_STRENGTH = "kc", "kphi", "cohesion"
_Factor = Annotated[float, Bounds("at least 0.01", lambda x: x >= 0.01)]


@settings
class RandomizationConfig:
    """Bounds of what each episode draws uniformly; nothing varies by default."""

    grip: tuple[_Factor, _Factor] = (1.0, 1.0)
    """Factor on the friction of rigid ground."""
    soil: tuple[_Factor, _Factor] = (1.0, 1.0)
    """Factor on stiffness and cohesion of all soils."""
    delay: tuple[CountOrZero, CountOrZero] = (0, 0)
    """Delay of commands, in steps of 0.1 s."""

    def check(self):
        for name, (low, high) in vars(self).items():
            if low > high:
                raise ValueError(f"{name}: expected least and most, found {low} and {high}")


@struct.dataclass
class DomainRandomization:
    """The draw of one episode; None for what does not vary.

    grip, soil: `[]` factors. delay: `[]` int32 steps. sent: `[D, 2]` the last actions, the latest
    first; D is the longest delay.
    """

    grip: jax.Array | None
    soil: jax.Array | None
    delay: jax.Array | None
    sent: jax.Array | None

    @classmethod
    def draw(cls, config: RandomizationConfig, key: jax.Array, action: jax.Array) -> Self:
        """Draws for an episode; `[2]` action is the one sent before it."""
        grip, soil, delay = jax.random.split(key, 3)

        def factor(key: jax.Array, span: tuple[float, float]) -> jax.Array | None:
            low, high = span
            return None if low == high == 1.0 else jax.random.uniform(key, (), None, low, high)

        drawn = cls(factor(grip, config.grip), factor(soil, config.soil), delay=None, sent=None)
        shortest, longest = config.delay
        if not longest:
            return drawn
        steps = jax.random.randint(delay, (), shortest, longest + 1)
        sent = jnp.broadcast_to(action, (longest, 2))
        return dataclasses.replace(drawn, delay=steps, sent=sent)

    def ground(self, terrain: TerrainMap) -> TerrainMap:
        """The ground that moves the vehicle, where the policy sees `terrain`."""
        if self.grip is not None:
            terrain = dataclasses.replace(terrain, grip=self.grip)
        if self.soil is not None:
            soils = query.soils(terrain)
            weaker = {x: self.soil * getattr(soils, x) for x in _STRENGTH}
            terrain = terrain.with_soils(dataclasses.replace(soils, **weaker))
        return terrain

    def arriving(self, action: jax.Array) -> tuple[jax.Array, Self]:
        """The action `[2]` that reaches the vehicle when `action` is sent, and the new state."""
        if self.delay is None or self.sent is None:
            return action, self
        sent = jnp.concatenate([action[None], self.sent])
        return sent[self.delay], dataclasses.replace(self, sent=sent[:-1])
