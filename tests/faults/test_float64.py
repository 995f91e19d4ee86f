"""JAX's switches: float64 widens nothing, and a search for NaN finds none."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from faults.widened import CASES, RUN

TESTS = Path(__file__).resolve().parents[1]


def found(cases=CASES, **switches):
    path = [str(TESTS.parent), str(TESTS), os.environ.get("PYTHONPATH", "")]
    settings = {**switches, "PYTHONPATH": os.pathsep.join(filter(None, path))}
    run = subprocess.run(
        [sys.executable, str(TESTS / "faults" / "widened.py"), *cases],
        env=os.environ | settings,
        stdout=subprocess.PIPE,
        text=True,
        timeout=300,
        check=True,
    )
    return json.loads(run.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def widened():
    return found(JAX_ENABLE_X64="1")


@pytest.mark.parametrize("case", CASES)
def test_the_switch_widens_nothing(widened, case):
    assert widened[case] == ["float32"]


def test_nothing_is_nan_in_episodes_and_trainings():
    assert found(RUN, JAX_DEBUG_NANS="1") == {case: ["float32"] for case in RUN}


@pytest.mark.slow
def test_without_the_switch_all_is_float32():
    assert found() == {case: ["float32"] for case in CASES}
