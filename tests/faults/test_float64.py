"""All is computed in float32, also where JAX is told to compute in float64 by default."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from faults.border import fault
from faults.widened import CASES

TESTS = Path(__file__).resolve().parents[1]


def found(switch):
    path = [str(TESTS.parent), str(TESTS), os.environ.get("PYTHONPATH", "")]
    settings = {"JAX_ENABLE_X64": switch, "PYTHONPATH": os.pathsep.join(filter(None, path))}
    run = subprocess.run(
        [sys.executable, str(TESTS / "faults" / "widened.py"), *CASES],
        env=os.environ | settings,
        stdout=subprocess.PIPE,
        text=True,
        timeout=300,
        check=True,
    )
    return json.loads(run.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def widened():
    return found("1")


@pytest.mark.parametrize("case", CASES)
@fault(AssertionError, "arrays are made without a dtype, which the switch makes float64")
def test_the_switch_widens_nothing(widened, case):
    assert widened[case] == ["float32"]


@pytest.mark.slow
def test_without_the_switch_all_is_float32():
    assert found("0") == {case: ["float32"] for case in CASES}
