"""Simulations side by side in processes."""

import os

import pytest

from vertiwm_jax.simulators.processes import simulating
from vertiwm_jax.simulators.protocol import SimulatorError


def test_a_process_that_is_killed_is_one_clear_error():
    with pytest.raises(SimulatorError, match="fewer jobs need less"), simulating(2) as mapped:
        list(mapped(os._exit, [1, 1]))


def test_values_come_in_order_whoever_is_first():
    for jobs in (1, 2):
        with simulating(jobs) as mapped:
            assert list(mapped(pow, range(20), [2] * 20)) == [x * x for x in range(20)]
