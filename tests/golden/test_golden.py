"""What is computed now is what was written down: `compute` says what of, `record` writes it."""

from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pytest
from golden.compute import GROUPS, SLOW, compute, stored

MOTION = {
    "position": (1e-3, 3e-2),
    "rpy": (4e-4, 2.5e-2),
    "velocity": (4e-3, 4e-2),
    "angular_velocity": (2.5e-3, 4e-2),
    "wheel_speed": (0.15, 1.5),
    "sinkage": (3e-4, 7e-3),
    "coefficients": (6e-3, 1.6e-2),
    "disagreement": (5e-4, 4.5e-3),
    "spread": (4e-5, 1.2e-4),
    "hidden": (0.1, 0.25),
}
"""SI units, in float32 and in bfloat16."""
TOLERANCES = {
    "worlds/*": (0.0, 1e-5),
    "sight/*": (0.0, 3e-5),
    "environment/embedding": (0.0, 4e-3),
    "environment/*": (0.0, 1e-4),
    **{f"rollout/*/bfloat16/{name}": (limit, 0.0) for name, (_, limit) in MOTION.items()},
    **{f"rollout/*/{name}": (limit, 0.0) for name, (limit, _) in MOTION.items()},
    "learning/*": (0.0, 2e-5),
    "fit/*": (0.0, 6e-3),
    "planning/episodes/*": (0.7, 0.0),  # Which plan is best is a matter of the last bits.
    "*": (0.0, 1e-3),
}
"""What an entry may be off, and as a share of the largest entry; the first pattern counts.

Three to six times the most that was seen between jax 0.10.2 and 0.11.2, CPUs with and without
AVX-512, and inputs that differ by a millionth; the last made nearly all of it.
"""


def tolerance(name: str, golden: np.ndarray) -> float:
    """How far an entry may be from the golden one."""
    absolute, share = next(x for pattern, x in TOLERANCES.items() if fnmatchcase(name, pattern))
    return absolute + share * float(np.max(np.abs(golden), initial=0.0))


def difference(name: str, found: Any, golden: Any) -> str | None:
    """What is said of a quantity that is another one now."""
    x, y = np.array(found), np.array(golden)
    if y.dtype.kind == "U":
        return None if found == golden else f"{name}: expected {golden}, found {found}"
    if x.shape != y.shape:
        return f"{name}: expected shape {y.shape}, found {x.shape}"
    apart, allowed = np.max(np.abs(x - y), initial=0.0), tolerance(name, y)
    return (
        None if apart <= allowed else f"{name}: {apart:.2e} apart, at most {allowed:.2e} expected"
    )


@pytest.mark.parametrize(
    "group",
    [pytest.param(x, marks=getattr(pytest.mark, "slow" if x in SLOW else "smoke")) for x in GROUPS],
)
def test_what_is_computed_is_what_was_written_down(group):
    found, golden = compute(group), stored(group)
    assert sorted(found) == sorted(golden)
    differences = [difference(name, found[name], x) for name, x in golden.items()]
    assert not (said := [line for line in differences if line]), "\n".join(said)
