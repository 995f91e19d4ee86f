"""Writes the golden numbers anew: `PYTHONPATH=tests python -m golden.record`, some minutes.

Groups that are named behind it are written alone, and the others stay. Numbers are to change only
with what they are of; a new version of JAX, or another machine, is within the test's tolerances.
"""

import json
import sys

import conftest  # noqa: F401 -- the tests' flags, before JAX starts
from golden.compute import GROUPS, STORE, compute, stored


def main(asked: list[str]) -> None:
    numbers = {}
    for group in GROUPS:
        numbers |= compute(group) if group in asked else stored(group)
    lines = (f"{json.dumps(name)}: {json.dumps(numbers[name])}" for name in sorted(numbers))
    STORE.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    main(sys.argv[1:] or list(GROUPS))
