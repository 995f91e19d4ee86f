"""What commands read of their command lines."""

from dataclasses import field
from pathlib import Path
from typing import Literal

import pytest

from vertiwm_jax import config
from vertiwm_jax.cli import arguments
from vertiwm_jax.config import Count


@config.settings
class Optimizer:
    """How weights move."""

    learning_rate: float = 3e-4
    """Step size."""
    clip: float | None = None
    anneal: bool = True
    count: Count = 1

    def check(self):
        if self.learning_rate <= 0:
            raise ValueError("learning_rate must be positive")


@config.settings
class Task:
    """Train something."""

    name: str
    seed: Count = 1
    suite: Literal["low", "mid", "high"] = "low"
    folder: Path = Path("runs")
    layers: tuple[int, ...] = (64, 64)
    speeds: tuple[float, float] = (0.0, 8.0)
    optimizer: Optimizer = field(default_factory=Optimizer)


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "task.yaml"
    path.write_text(text)
    return path


def parse(default: Path, argv: list[str]) -> Task:
    return arguments.with_file(Task, default, "door", argv)


def test_the_command_line_overrides_the_file(tmp_path):
    default = write(tmp_path, "name: x\nseed: 5\noptimizer: {clip: 2}")
    other = tmp_path / "other.yaml"
    other.write_text("name: y")
    assert parse(default, []) == Task("x", 5, optimizer=Optimizer(clip=2.0))
    argv = ["--optimizer.learning-rate", "1e-2", "--layers", "1", "2", "--optimizer.clip", "None"]
    argv += ["--optimizer.anneal", "False", "--suite", "mid"]
    assert parse(default, argv) == Task(
        "x", 5, "mid", layers=(1, 2), optimizer=Optimizer(1e-2, None, False)
    )
    assert parse(default, ["--seed", "7", "--config", str(other)]) == Task("y", 7)
    assert parse(default, [f"--config={other}"]) == Task("y")


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--config", "nowhere.yaml"], ["door: error:", "nowhere.yaml: no such file"]),
        (["--sede", "3"], ["--sede", "--seed"]),
        (["--seed", "many"], ["--seed", "many"]),
        (["--seed", "0"], ["seed: expected at least 1, found 0"]),
        (["--optimizer.count", "0"], ["count: expected at least 1, found 0"]),
        (["--config", "tusk"], ["no configuration named 'tusk'"]),
        (["--optimizer.learning-rate", "-1"], ["learning_rate must be positive"]),
    ],
)
def test_a_bad_command_line_ends_with_status_2(tmp_path, capsys, argv, words):
    with pytest.raises(SystemExit) as stop:
        parse(write(tmp_path, "name: x"), argv)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    text = captured.out + captured.err
    for word in words:
        assert word in text


def test_only_verbose_tells_which_compiler_options_are_left_out(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(arguments.xla, "left_out", lambda: ["xla_of_another_version"])
    default = write(tmp_path, "name: x")
    assert parse(default, []) == parse(default, ["--verbose"])
    assert capsys.readouterr().out == "compiler options left out: xla_of_another_version\n"


def test_help_names_every_field(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        parse(write(tmp_path, "name: x\nseed: 41"), ["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    options = [
        "--config",
        "--name",
        "--seed",
        "--suite",
        "--folder",
        "--layers",
        "--speeds",
    ]
    options += ["--optimizer.learning-rate", "--optimizer.clip", "--optimizer.anneal"]
    for word in [*options, "Train something.", "Step size.", "41"]:
        assert word in text


def test_a_name_is_that_of_a_file_that_comes_along(tmp_path, monkeypatch):
    write(tmp_path, "name: y")
    monkeypatch.setattr(config, "_FOLDERS", (tmp_path,))
    other = tmp_path / "other.yaml"
    other.write_text("name: x")
    assert parse(other, ["--config", "task"]) == Task("y")
    assert parse(other, []) == Task("x")
