"""What is computed now is what was written down: `compute` says what of, `record` writes it."""

from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pytest
from golden.compute import GROUPS, SLOW, compute, stored

MOTION = {
    "position": (6e-4, 3e-2),
    "rpy": (2e-4, 2.5e-2),
    "velocity": (2e-3, 4e-2),
    "angular_velocity": (1.3e-3, 4e-2),
    "wheel_speed": (0.08, 1.5),
    "sinkage": (1.5e-4, 7e-3),
    "coefficients": (3e-3, 1.6e-2),
    "disagreement": (2.5e-4, 4.5e-3),
    "spread": (2e-5, 1.2e-4),
    "hidden": (0.05, 0.25),
}
"""SI units, in float32 and in bfloat16."""
TOLERANCES = {
    "worlds/*": (5e-5, 0.0),
    "sight/soil/*": (0.0, 3e-5),
    "sight/*": (3e-5, 0.0),
    "environment/embedding": (2e-3, 0.0),
    "environment/reward": (3e-3, 0.0),
    "environment/*": (3e-4, 0.0),
    **{f"rollout/*/bfloat16/{name}": (limit, 0.0) for name, (_, limit) in MOTION.items()},
    **{f"rollout/*/{name}": (limit, 0.0) for name, (limit, _) in MOTION.items()},
    "learning/*/clip_fraction": (3e-3, 0.0),  # Some thousandths are a sample more or less.
    "learning/*": (4e-5, 2e-5),
    "fit/*/gradient": (3e-7, 1e-2),
    "fit/*/constants/response": (6e-3, 0.0),
    "fit/*/constants/*": (4e-5, 2e-3),
    "fit/*": (0.0, 4e-3),
    # Whether a vehicle collides 0.1 s earlier, or which plan is best, is a matter of the last bits.
    "*/episodes/*": (0.7, 0.0),
    "*": (1e-5, 1e-3),
}
"""What an entry may be off, and as a share of it; the first pattern counts.

About twice to six times the most that was seen between jax 0.10.2 and 0.11.2, CPUs with and without
AVX-512, and inputs that differ by a millionth; the last made nearly all of it.
"""


def difference(name: str, found: Any, golden: Any) -> str | None:
    """What is said of a quantity that is another one now."""
    x, y = np.array(found), np.array(golden)
    if y.dtype.kind == "U":
        return None if found == golden else f"{name}: expected {golden}, found {found}"
    if x.shape != y.shape:
        return f"{name}: expected shape {y.shape}, found {x.shape}"
    limit, share = next(x for pattern, x in TOLERANCES.items() if fnmatchcase(name, pattern))
    apart = np.abs(x - y)
    if np.all(apart <= limit + share * np.abs(y)):
        return None
    return f"{name}: up to {apart.max():.2e} apart, expected {limit:g} and {share:g} of each entry"


@pytest.mark.parametrize(
    "group",
    [pytest.param(x, marks=getattr(pytest.mark, "slow" if x in SLOW else "smoke")) for x in GROUPS],
)
def test_what_is_computed_is_what_was_written_down(group):
    found, golden = compute(group), stored(group)
    assert sorted(found) == sorted(golden)
    differences = [difference(name, found[name], x) for name, x in golden.items()]
    assert not (said := [line for line in differences if line]), "\n".join(said)
