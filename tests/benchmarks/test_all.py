"""`python -m benchmarks` runs what can be run, and says what it leaves out."""

import json
import subprocess
import sys
from types import SimpleNamespace

from benchmarks import __main__ as everything


def test_peers_that_are_not_installed_are_left_out_in_one_line(tmp_path, monkeypatch, capsys):
    ran = []

    def run(command, **_):
        ran.append(command[-2])
        result = {"hardware": {"cores": 1}, "results": {"a case": {"steps_per_s": 2.0}}}
        return SimpleNamespace(stdout=json.dumps(result))

    monkeypatch.setattr(everything, "find_spec", lambda name: None)
    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(sys, "argv", ["benchmarks", "--output", str(tmp_path / "page.md")])
    everything.main()
    assert "benchmarks.models" in ran
    assert not {"benchmarks.chrono", "benchmarks.torch_peer", "benchmarks.peers"} & set(ran)
    lines = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert lines == [
        "chrono is left out: it needs pychrono (see docs/collect.md)",
        'torch_peer is left out: it needs torch (pip install -e ".[peers]")',
    ]
