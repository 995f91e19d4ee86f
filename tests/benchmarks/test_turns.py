import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from benchmarks import turns


def test_ratio_is_of_pairs_and_its_interval_narrows_as_they_agree():
    mean, low, high = turns.ratio([1.0, 2.0, 4.0], [1.1, 2.2, 4.4])
    assert low == pytest.approx(high) == pytest.approx(mean) == pytest.approx(1.1)
    mean, low, high = turns.ratio([1.0, 1.0, 1.0], [0.9, 1.0, 1 / 0.9])
    assert mean == pytest.approx(1) and low == pytest.approx(1 / high)
    assert high == pytest.approx(1.299, abs=1e-3)  # t of 2 degrees of freedom: 4.303


def test_checkouts_take_turns_and_figures_are_told_by_case(tmp_path, monkeypatch, capsys):
    ran = []

    def run(command, cwd, **_):
        ran.append(cwd.name)
        figures = {"steps_per_s": 100.0 if cwd.name == "before" else 120.0, "calls": 3}
        return SimpleNamespace(stdout=json.dumps({"results": {"a case": figures}}))

    monkeypatch.setattr(subprocess, "run", run)
    argv = ["--pairs", "2", str(tmp_path / "before"), str(tmp_path / "after"), "models", "--quick"]
    monkeypatch.setattr(sys, "argv", ["turns", *argv])
    turns.main()
    assert ran == ["before", "after", "after", "before"]
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.strip() == "a case, steps_per_s: 100 -> 120, 1.200 (1.200 to 1.200)"
