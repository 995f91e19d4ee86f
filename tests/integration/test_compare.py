"""The table of policies from end to end, on settings so small that compiling is all their cost."""

import shutil
import sys

import pytest
from doors import door, opened, refusal, squeezed

from vertiwm_jax import config as configuration
from vertiwm_jax import machine, runs
from vertiwm_jax.evaluation import compare
from vertiwm_jax.evaluation.compare import CompareConfig, Row

SHARED = """
ground: {train_worlds: 2, suites: [easy], suite_worlds: 1, starts: 8, pairs: 1}
navigation: {horizon_seconds: 2, settle_steps: 2}
simulator: {substeps: 1}
action_repeat: 2
"""
PPO = """
ppo:
  {total_timesteps: 256, num_envs: 8, num_steps: 8, minibatches: 2, epochs: 1, hidden: [8]}
"""
TABLE = """
rows: [{algorithm: ppo, model: builtin}, {algorithm: ppo, model: nesam}]
suites: [easy]
suite_worlds: 1
"""


@pytest.mark.slow
def test_policies_are_trained_once_and_judged_together(tmp_path, monkeypatch):
    (tmp_path / "ppo.yaml").write_text(SHARED + PPO)
    (tmp_path / "table.yaml").write_text(TABLE)
    first = ["--config", str(tmp_path / "table.yaml"), "--settings", str(tmp_path)]
    table = opened(door("compare"), tmp_path, *first)
    run = table()
    trainings = [*run.glob("ppo_in_*/ppo-*")]
    assert sorted(path.parent.name for path in trainings) == ["ppo_in_builtin", "ppo_in_nesam"]
    text = (run / "table.md").read_text()
    for policy in ("ppo in builtin", "ppo in nesam", "straight to goal"):
        assert f"| {policy} |" in squeezed(text)
    assert (run / "builtin" / "episodes.csv").read_text().count("straight to goal") == 10
    # Stopped before its test: it is not trained again, but tested.
    (nesam,) = run.glob("ppo_in_nesam/ppo-*")
    before, kept = runs.read_metrics(nesam), (nesam / "config.yaml").read_text()
    faster = machine.multiplies_bfloat16()
    monkeypatch.setattr(machine, "multiplies_bfloat16", lambda: not faster)
    (nesam / "summary.json").unlink()
    shutil.rmtree(run / "builtin")
    table("--resume", str(run))
    assert [*run.glob("ppo_in_*/ppo-*")] == trainings
    assert runs.read_metrics(nesam) == before
    assert (nesam / "config.yaml").read_text() == kept
    assert (nesam / "summary.json").is_file()
    assert (run / "table.md").read_text() == text


def test_the_table_of_the_paper_is_configured():
    config = configuration.load(CompareConfig, configuration.default_config("table3"))
    assert [str(row) for row in config.rows[:3]] == [
        "ppo in transformer", "ppo in nesam", "ppo in vertiwm",
    ]  # fmt: skip
    for row in config.rows:
        settings = compare.training(config, row)
        assert (settings.name, settings.model) == (row.algorithm, row.model)


def test_tables_without_sense_are_refused(tmp_path):
    row = Row("ppo", "nesam")
    with pytest.raises(ValueError, match="rows: expected at least one"):
        CompareConfig(rows=())
    with pytest.raises(ValueError, match="once"):
        CompareConfig(rows=(row, row))
    with pytest.raises(ValueError, match="jobs: expected at least 1, found 0"):
        CompareConfig(rows=(row,), jobs=0)
    message = refusal(door("compare"), "--settings", tmp_path / "none", "--runs", tmp_path / "runs")
    assert "ppo.yaml: no such file" in message
    assert not (tmp_path / "runs").exists()


def test_chrono_is_asked_for_before_hours_of_training(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pychrono", None)
    message = refusal(door("compare"), "--simulators", "chrono", "--runs", tmp_path / "runs")
    assert "expected PyChrono 9.0" in message
    assert not (tmp_path / "runs").exists()
