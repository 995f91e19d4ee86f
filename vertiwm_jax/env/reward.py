"""The reward of goal navigation: progress, minus discomfort and stalling, plus the ending."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from vertiwm_jax.env.termination import TerminationReason


@dataclasses.dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward, in Verti-Bench's shape; penalties are subtracted.

    progress: for each meter by which the cost to go falls.
    stalled: for each stalled step.
    tilt: for roll and for pitch beyond `tilt_limit`.
    tilt_limit: roll and pitch that cost nothing, rad.
    vertical: for each m/s of vertical speed, each step.
    goal, stuck, failure: once, at the end; failure is any other terminal ending. Verti-Bench takes
        300 and 600; for more, a detour is worth its time.
    timed_out, timed_out_distance: once at the time limit, and for each meter left then.
    disagreement: for each meter by which the specialists of a model disagree, each step.
    spread: for each meter of spread of its gates, each step.
    """

    progress: float = 50.0
    stalled: float = 10.0
    tilt: float = 20.0
    tilt_limit: float = math.radians(30)
    vertical: float = 1.0
    goal: float = 3000.0
    stuck: float = 2000.0
    failure: float = 2000.0
    timed_out: float = 100.0
    timed_out_distance: float = 10.0
    disagreement: float = 0.0
    spread: float = 0.0


def reward(
    config: RewardConfig,
    *,
    progress: jax.Array,
    distance: jax.Array,
    stalled: jax.Array,
    tilt: jax.Array,
    vertical_speed: jax.Array,
    disagreement: jax.Array,
    spread: jax.Array,
    ending: jax.Array,
) -> jax.Array:
    """`[...]` reward of one 0.1 s step.

    progress: m by which the cost to go fell; distance: m left; stalled: bool; tilt: `[..., 2]` roll
    and pitch, rad; vertical_speed: m/s in the world frame; disagreement, spread: m; ending:
    `TerminationReason` codes.
    """
    size = jnp.abs(tilt)
    beyond = size / config.tilt_limit * jnp.maximum(size - config.tilt_limit, 0.0)
    return (
        config.progress * progress
        - config.stalled * stalled
        - config.tilt * jnp.sum(beyond, axis=-1)
        - config.vertical * jnp.abs(vertical_speed)
        - config.disagreement * disagreement
        - config.spread * spread
        + ending_reward(config, ending, distance)
    )


def ending_reward(config: RewardConfig, ending: jax.Array, distance: jax.Array) -> jax.Array:
    """`[...]` what a `TerminationReason` adds, `distance` m from the goal; 0 for `RUNNING`."""
    named = {
        TerminationReason.RUNNING: 0.0,
        TerminationReason.TIMED_OUT: -config.timed_out - config.timed_out_distance * distance,
        TerminationReason.GOAL: config.goal,
        TerminationReason.STUCK: -config.stuck,
    }
    return jnp.select([ending == code for code in named], list(named.values()), -config.failure)
