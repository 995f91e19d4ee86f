import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vertiwm_jax import config
from vertiwm_jax.config import (
    AtLeastOne,
    ConfigError,
    Count,
    CountOrZero,
    Discount,
    NotNegative,
    Positive,
    Share,
)


@dataclass(frozen=True)
class Optimizer:
    """How weights move."""

    learning_rate: float = 3e-4
    """Step size."""
    clip: float | None = None
    anneal: bool = True

    def __post_init__(self):
        if self.learning_rate <= 0:
            raise ValueError("learning_rate must be positive")


@dataclass(frozen=True)
class Task:
    """Train something."""

    name: str
    seed: int = 0
    suite: Literal["low", "mid", "high"] = "low"
    folder: Path = Path("runs")
    layers: tuple[int, ...] = (64, 64)
    speeds: tuple[float, float] = (0.0, 8.0)
    optimizer: Optimizer = field(default_factory=Optimizer)


@dataclass(frozen=True)
class Careful:
    """Learns slowly unless told otherwise."""

    task: Task = Task("careful", optimizer=Optimizer(1e-5, clip=0.5))


@config.settings
class Bounded:
    """Numbers within bounds."""

    count: Count = 1
    repeats: CountOrZero | None = None
    rate: Positive = 1.0
    weights: tuple[NotNegative, NotNegative] = (0.0, 1.0)
    discount: Discount = 0.9
    share: Share = 1.0
    noise: NotNegative = 0.0
    names: Annotated[tuple[str, ...], AtLeastOne] = ("a",)


@config.settings
class Joined(Bounded):
    """Two of which belong together."""

    GONE: ClassVar = {"number": "is now count"}
    inner: Bounded = Bounded()

    def check(self) -> None:
        if self.count > 3 * self.rate:
            raise ValueError(f"count: expected three times the rate at most, found {self.count}")


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "task.yaml"
    path.write_text(text)
    return path


def test_every_kind_of_field_is_read(tmp_path):
    text = """
name: crawl
seed: 3
suite: high
folder: out/here
layers: [8, 16, 32]
speeds: [-1, 4.5]
optimizer: {learning_rate: 1e-3, clip: 1, anneal: off}
"""
    expected = Task(
        "crawl", 3, "high", Path("out/here"), (8, 16, 32), (-1.0, 4.5), Optimizer(1e-3, 1.0, False)
    )
    found = config.load(Task, write(tmp_path, text))
    assert found == expected
    assert type(found.optimizer.clip) is float
    assert config.load(Task, write(tmp_path, "name: x")) == Task("x")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name: x\nsede: 1", ["sede", "unknown key", "did you mean 'seed'?"]),
        ('"a\\nb": 1', [r"'a\nb': unknown key"]),
        ("name: x\noptimizer: {learnin_rate: 1}", ["optimizer.learnin_rate", "'learning_rate'?"]),
        ("name: x\nseed: 1.5", ["seed", "expected int", "found 1.5 (float)"]),
        ("name: x\nseed: true", ["seed", "expected int", "found True (bool)"]),
        ("name: x\noptimizer: {anneal: 1}", ["optimizer.anneal", "expected bool", "found 1 (int)"]),
        ("name: x\noptimizer: {clip: big}", ["optimizer.clip", "float or null", "'big' (str)"]),
        ("name: x\noptimizer: {learning_rate: -1}", ["optimizer: learning_rate must be positive"]),
        ("name: x\noptimizer: 3", ["optimizer", "mapping of Optimizer fields", "found 3"]),
        ("name: x\nsuite: hihg", ["suite", "'low', 'mid', 'high'", "did you mean 'high'?"]),
        ("name: x\nlayers: [1, two]", ["layers[1]", "expected int", "found 'two' (str)"]),
        ("name: x\nlayers: 64", ["layers", "expected a list of int", "found 64 (int)"]),
        ("name: x\nspeeds: [1]", ["speeds", "a list of 2", "found a list of 1"]),
        ("name: 3", ["name", "expected str", "found 3 (int)"]),
        ("name: x\nfolder: 3", ["folder", "expected a path", "found 3 (int)"]),
        ("seed: 1", ["name", "missing", "expected str"]),
        ("- 1", ["expected a mapping of Task fields", "found a list of 1"]),
        ("name: x\nname: y", ["not valid YAML", "repeated key 'name'", "line 2"]),
        ("name: [x", ["not valid YAML", "line"]),
    ],
)
def test_bad_files_are_refused_in_one_clear_line(tmp_path, text, words):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        config.load(Task, path)
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    for word in words:
        assert word in message


OUT_OF_BOUNDS = [
    ({"count": 0}, "count: expected at least 1, found 0"),
    ({"repeats": -1}, "repeats: expected at least 0, found -1"),
    ({"rate": 0.0}, "rate: expected more than 0, found 0.0"),
    ({"rate": float("nan")}, "rate: expected more than 0, found nan"),
    ({"weights": (1.0, -1.0)}, "weights: expected at least 0, found (1.0, -1.0)"),
    ({"discount": 1.0}, "discount: expected between 0 and 1, found 1.0"),
    ({"share": 1.5}, "share: expected 0 to 1, found 1.5"),
    ({"noise": -0.5}, "noise: expected at least 0, found -0.5"),
    ({"names": ()}, "names: expected at least one, found none"),
]


@pytest.mark.parametrize(("values", "message"), OUT_OF_BOUNDS)
def test_values_out_of_bounds_are_refused_in_python_and_in_files(tmp_path, values, message):
    assert Bounded(repeats=0, rate=float("inf"), share=0.0).share == 0
    for kind in (Bounded, Joined):
        with pytest.raises(ConfigError, match=re.escape(message)):
            kind(**values)
    ((name, value),) = values.items()
    text = f"inner: {{{name}: {list(value) if isinstance(value, tuple) else value}}}"
    text = text.replace("nan", ".nan")
    with pytest.raises(ConfigError, match=re.escape(f"inner: {message}")):
        config.load(Joined, write(tmp_path, text))


def test_keys_of_earlier_versions_are_told_what_became_of_them(tmp_path):
    with pytest.raises(ConfigError, match=r"task\.yaml: number: is now count"):
        config.load(Joined, write(tmp_path, "number: 3"))


def test_what_joins_fields_is_checked_after_bounds():
    with pytest.raises(ValueError, match="three times the rate at most, found 7"):
        Joined(count=7)
    with pytest.raises(ConfigError, match="rate: expected more than 0"):
        Joined(count=7, rate=-1.0)


def test_a_mapping_changes_what_it_names_and_leaves_the_rest_of_a_default(tmp_path):
    path = write(tmp_path, "task: {seed: 1, optimizer: {anneal: off}}")
    expected = Task("careful", 1, optimizer=Optimizer(1e-5, clip=0.5, anneal=False))
    assert config.load(Careful, path) == Careful(expected)
    path = write(tmp_path, "task: {optimizer: {learning_rate: -1}}")
    with pytest.raises(ConfigError, match=r"task.optimizer: learning_rate must be positive"):
        config.load(Careful, path)


def test_missing_and_unreadable_files(tmp_path):
    write(tmp_path, "name: x")
    with pytest.raises(ConfigError, match=r"tusk\.yaml: no such file.*did you mean 'task\.yaml'"):
        config.load(Task, tmp_path / "tusk.yaml")
    with pytest.raises(ConfigError, match="readable"):
        config.load(Task, tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="UTF-8"):
        config.load(Task, tmp_path / "binary.yaml")


@settings(max_examples=30, deadline=None)
@given(
    name=st.text() | st.sampled_from(["1e3", "1_0e5", "on", "null", "3", "~", "1.5", ""]),
    rate=st.floats(min_value=1e-300, allow_nan=False),
    clip=st.none() | st.floats(allow_nan=False),
    layers=st.lists(st.integers()).map(tuple),
)
def test_what_is_saved_is_read_back_equal(tmp_path_factory, name, rate, clip, layers):
    path = tmp_path_factory.mktemp("saved") / "config.yaml"
    task = Task(name, layers=layers, optimizer=Optimizer(rate, clip))
    config.save(task, path)
    assert config.load(Task, path) == task


def test_numbers_of_numpy_are_saved_as_plain_ones():
    task = Task("x", np.int32(3), layers=(np.int64(8),), optimizer=Optimizer(np.float64(0.5)))
    plain = Task("x", 3, layers=(8,), optimizer=Optimizer(0.5))
    assert config.dump(task) == config.dump(plain)


def test_default_configs_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(config, "_FOLDERS", (tmp_path / "absent", tmp_path))
    path = write(tmp_path, "name: x")
    assert config.default_config("task") == path
    with pytest.raises(ConfigError, match=r"no configuration named 'tusk'.*did you mean 'task'"):
        config.default_config("tusk")
