"""Settings of any kind are read, or refused in one line that names file and field."""

import copy
import dataclasses
import math
from pathlib import Path
from typing import Annotated

import pytest
import yaml
from doors import door
from faults.border import outcome
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vertiwm_jax import config
from vertiwm_jax.config import ConfigError
from vertiwm_jax.evaluation.compare import CompareConfig
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.experiment import FitConfig
from vertiwm_jax.mechanics.vehicle import VehicleConfig
from vertiwm_jax.models import files as models
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.rl.experiment import TRAININGS
from vertiwm_jax.simulators.collection import CollectConfig

pytestmark = pytest.mark.slow
FILES = {
    **{name: (TRAININGS["ppo"], name) for name in ("ppo", "ppo_small", "paper/ppo")},
    **{name: (TRAININGS[name], name) for name in ("sac", "td3")},
    **{name: (FitConfig, name) for name in ("fit_chrono", "fit_paper", "fine_tune", "gates")},
    **{name: (FitConfig, name) for name in ("adapt", "any_vehicle")},
    "table3": (CompareConfig, "table3"),
    "import_nedm": (ImportSettings, "import_nedm"),
    "rover": (VehicleConfig, "vehicles/rover"),
    "hmmwv": (VehicleConfig, "vehicles/hmmwv"),
    "collect": (CollectConfig, None),
    "model": (ModelConfig, models.PRETRAINED / "model.yaml"),
}
"""Dataclass and shipped file of each."""
EXAMPLES = settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
NUMBERS = st.one_of(
    st.floats(allow_nan=True),
    st.integers(),
    st.sampled_from([math.nan, math.inf, -math.inf, -1, 0, 10**10, 10**30, 1e300, -1e-300]),
)
VALUES = st.recursive(
    st.one_of(NUMBERS, st.none(), st.booleans(), st.text(max_size=8), st.dates()),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=4,
)


def text(name: str) -> str:
    """All settings of a shipped file, also those that it leaves to their defaults."""
    cls, file = FILES[name]
    if file is None:
        return config.dump(cls(Path("drives")))
    found = file if isinstance(file, Path) else config.default_config(file)
    return config.dump(config.load(cls, found))


def places(tree: object, path: tuple = ()) -> list[tuple]:
    """The paths of all that a tree holds."""
    found = [path] if path else []
    inner = tree.items() if isinstance(tree, dict) else ()
    return found + [place for key, value in inner for place in places(value, (*path, key))]


def numbers(value: object) -> list[float]:
    """All numbers in settings."""
    if dataclasses.is_dataclass(value):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    if isinstance(value, list | tuple):
        return [x for each in value for x in numbers(each)]
    return [value] if isinstance(value, int | float) else []


@pytest.mark.parametrize("name", FILES)
def test_any_value_in_any_place_is_read_or_refused(tmp_path, name):
    cls, whole = FILES[name][0], yaml.safe_load(text(name))
    file = tmp_path / "settings.yaml"

    @EXAMPLES
    @given(st.sampled_from(places(whole)), VALUES)
    def check(place, value):
        tree = copy.deepcopy(whole)
        inside = tree
        for key in place[:-1]:
            inside = inside[key]
        inside[place[-1]] = value
        file.write_text(yaml.safe_dump(tree, allow_unicode=True), encoding="utf-8")
        found, refused = outcome(lambda: config.load(cls, file), ConfigError)
        if refused is None:
            assert not any(math.isnan(x) for x in numbers(found)), place
            assert all(abs(x) < 2**63 for x in numbers(found) if isinstance(x, int)), place
        else:
            assert refused.startswith(f"{file}: ") and len(refused) < 2000
            assert any(str(key) in refused for key in (*place, *inside)), refused

    check()


@pytest.mark.parametrize("name", FILES)
def test_an_unknown_key_in_any_place_is_refused(tmp_path, name):
    cls, whole = FILES[name][0], yaml.safe_load(text(name))
    file = tmp_path / "settings.yaml"
    mappings = [()] + [place for place in places(whole) if isinstance(at(whole, place), dict)]

    @EXAMPLES
    @given(st.sampled_from(mappings), st.text(max_size=8) | NUMBERS | st.none(), VALUES)
    def check(place, key, value):
        tree = copy.deepcopy(whole)
        inside = at(tree, place)
        if key in inside:
            return
        inside[key] = value
        file.write_text(yaml.safe_dump(tree, allow_unicode=True), encoding="utf-8")
        _, refused = outcome(lambda: config.load(cls, file), ConfigError)
        assert refused and refused.startswith(f"{file}: ")

    check()


def at(tree: dict, place: tuple) -> object:
    for key in place:
        tree = tree[key]
    return tree


@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file_is_read_or_refused(tmp_path, name):
    cls, whole = FILES[name][0], text(name).encode()
    file = tmp_path / "settings.yaml"
    place = st.integers(0, len(whole))

    @EXAMPLES
    @given(place, place, st.binary(max_size=4) | st.text(max_size=4).map(str.encode))
    def check(first, last, instead):
        first, last = sorted((first, last))
        file.write_bytes(whole[:first] + instead + whole[last:])
        _, refused = outcome(lambda: config.load(cls, file), ConfigError)
        assert refused is None or refused.startswith(f"{file}: ")

    check()


WORDS = {
    "ppo": ["--seed", "--ppo.num-envs", "--navigation.sensing.range", "--loop.seeds"],
    "fit": ["--seed", "--windows.batch", "--splits.shares", "--loss.velocity"],
    "evaluate prediction": ["--context", "--horizons", "--split", "--splits.shares"],
    "evaluate calibration": ["--context", "--horizons", "--splits.whole"],
    "evaluate navigation": ["--policy", "--seed", "--sensing-range", "--suites", "--pairs"],
    "compare": ["--seed", "--suites", "--simulators", "--jobs"],
    "collect": ["--seed", "--seconds", "--drives", "--kinds", "--simulator"],
    "identify": ["--free", "--horizon", "--vehicle"],
    "view": ["--model", "--task", "--movie", "--suite"],
}
"""Commands, and some options of each."""
NEEDED = {
    "evaluate prediction": ["--data", "none"],
    "evaluate calibration": ["--data", "none"],
    "evaluate navigation": ["--policy", "straight", "--terrain", "none"],
    "collect": ["--output", "none", "--terrain", "none"],
    "identify": ["none", "--output", "mine.yaml"],
    "view": ["none"],
    "ppo": ["--terrain", "none"],
    "fit": ["--data", "none"],
    "compare": ["--settings", "none"],
}
"""Without these they ask for nothing else; what they name is not there, so that nothing begins."""


@pytest.mark.parametrize("name", WORDS)
def test_any_option_is_refused_in_one_line(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    command, *test = name.split()

    @EXAMPLES
    @given(
        st.sampled_from(WORDS[name]), st.lists(NUMBERS.map(str) | st.text(max_size=6), max_size=3)
    )
    def check(option, words):
        with pytest.raises(SystemExit) as stop:
            door(command)([*test, *NEEDED[name], option, *words])
        told = stop.value.code
        if isinstance(told, str):
            assert told.startswith("error: ") and "\n" not in told
        else:
            assert told in (0, 2)
        assert "Traceback" not in capsys.readouterr().err

    check()


@config.settings
class Numbers:
    bounded: Annotated[float, config.Bounds("any", lambda x: True)] = 0.0
    free: float = 0.0
    several: tuple[float, ...] = ()
    maybe: float | None = None


@pytest.mark.parametrize(
    "given",
    [{"bounded": math.nan}, {"free": math.nan}, {"several": (1.0, math.nan)}, {"maybe": math.nan}],
)
def test_no_setting_is_nan(given):
    (name,) = given
    expected = "finite numbers" if name == "several" else "a number"
    with pytest.raises(ConfigError, match=f"{name}: expected {expected}, found .*nan"):
        Numbers(**given)
