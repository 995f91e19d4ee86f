import math

import jax.numpy as jnp
import pytest

from vertiwm_jax.env.reward import RewardConfig, reward
from vertiwm_jax.env.termination import TerminationReason as Reason
from vertiwm_jax.env.termination import first_ending, is_terminal


def value(**changes):
    terms = {
        "progress": 0.0,
        "distance": 30.0,
        "stalled": False,
        "tilt": (0.0, 0.0),
        "vertical_speed": 0.0,
        "disagreement": 0.0,
        "spread": 0.0,
        "ending": Reason.RUNNING,
    }
    terms.update(changes)
    arrays = {name: jnp.asarray(x) for name, x in terms.items()}
    config = RewardConfig(stuck=300.0, failure=600.0, disagreement=100.0, spread=1000.0)
    return float(reward(config, **arrays))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"progress": 0.4}, 20.0),
        ({"progress": -0.1}, -5.0),
        ({"stalled": True}, -10.0),
        ({"tilt": (math.radians(29.9), 0.0)}, 0.0),
        # -20 (45/30) (15 deg in rad), either sign, roll or pitch.
        ({"tilt": (math.radians(-45), 0.0)}, -7.853982),
        ({"tilt": (0.0, math.radians(45))}, -7.853982),
        ({"vertical_speed": -0.5}, -0.5),
        ({"disagreement": 0.02}, -2.0),
        ({"spread": 0.003}, -3.0),
        ({"ending": Reason.GOAL}, 3000.0),
        ({"ending": Reason.STUCK}, -300.0),
        ({"ending": Reason.OFF_MAP}, -600.0),
        ({"ending": Reason.ROLLED_OVER}, -600.0),
        ({"ending": Reason.COLLIDED}, -600.0),
        ({"ending": Reason.DIVERGED}, -600.0),
        ({"ending": Reason.TIMED_OUT}, -400.0),
        ({"progress": 0.2, "stalled": True, "ending": Reason.TIMED_OUT}, -400.0),
    ],
)
def test_terms_are_those_computed_by_hand(changes, expected):
    assert value(**changes) == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_the_gravest_ending_counts_and_only_time_out_is_not_terminal():
    yes, no = jnp.array(True), jnp.array(False)
    conditions = dict.fromkeys(Reason, no)
    del conditions[Reason.RUNNING]
    assert int(first_ending(conditions)) == Reason.RUNNING
    both = conditions | {
        Reason.GOAL: yes,
        Reason.ROLLED_OVER: yes,
        Reason.TIMED_OUT: yes,
    }
    assert int(first_ending(both)) == Reason.ROLLED_OVER
    late = conditions | {Reason.GOAL: yes, Reason.TIMED_OUT: yes}
    assert int(first_ending(late)) == Reason.GOAL
    assert [bool(is_terminal(jnp.int32(e))) for e in Reason] == [False, False] + [True] * 6
