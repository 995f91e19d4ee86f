import jax
import pytest

from benchmarks import bogged
from vertiwm_jax.env import suites
from vertiwm_jax.env.controllers import LookAhead
from vertiwm_jax.env.suites import GroundConfig


@pytest.mark.slow
def test_who_may_reverse_frees_some_of_the_bogged(monkeypatch):
    monkeypatch.setattr(bogged, "CANDIDATES", 8)
    terrain = suites.suite_worlds(GroundConfig(suites=("hard",), suite_worlds=4), jax.random.key(1))
    tasks = bogged.bogged(terrain, 16, jax.random.key(1))
    forwards, both_ways = (
        bogged.freed(bogged.driven(config, terrain, tasks, LookAhead(config))[0])
        for config in (bogged.FORWARDS, bogged.BOTH_WAYS)
    )
    assert forwards["bogged"] == both_ways["bogged"] >= 4
    assert forwards["freed"] == 0 and both_ways["freed"] >= 2
