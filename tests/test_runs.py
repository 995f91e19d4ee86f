import itertools
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from disks import full_disk
from tensorboardX.proto.event_pb2 import Event

from vertiwm_jax import config, runs, trackers
from vertiwm_jax.runs import Progress, Run, RunError, read_metrics
from vertiwm_jax.trackers import TrackingError


@dataclass(frozen=True)
class Settings:
    seed: int = 1


def scalars(folder: Path) -> list[tuple[int, str, float]]:
    """What TensorBoard would read: records of length, checksum, payload, checksum."""
    found = []
    for file in sorted(folder.glob("events.out.tfevents.*")):
        data = file.read_bytes()
        while data:
            length = int.from_bytes(data[:8], "little")
            event = Event.FromString(data[12 : 12 + length])
            found += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
            data = data[12 + length + 4 :]
    return found


def steps(folder: Path) -> list[float]:
    return [entry["step"] for entry in read_metrics(folder)]


def test_a_run_keeps_configuration_and_metrics(tmp_path):
    with Run.create(tmp_path / "runs", "ppo", Settings(7)) as run:
        run.log(10, {"return": 1.5})
        # Readable at once by someone who watches, not only at the end.
        assert read_metrics(run.folder)[0]["return"] == 1.5
        run.log(20, {"return": 2.5, "loss": 0.25})
    assert run.folder.parent == tmp_path / "runs"
    assert run.folder.name.startswith("ppo-20")
    assert config.load(Settings, run.folder / "config.yaml") == Settings(7)
    first, second = read_metrics(run.folder)
    assert (first["step"], second["step"], second["loss"]) == (10, 20, 0.25)
    assert first["wall_time"] <= second["wall_time"]
    assert scalars(run.folder) == [(10, "return", 1.5), (20, "return", 2.5), (20, "loss", 0.25)]


def test_two_runs_of_one_second_have_two_folders(tmp_path):
    made = {Run.create(tmp_path, "a", Settings()).folder for _ in range(3)}
    assert len(made) == 3


def test_resuming_drops_what_followed_the_checkpoint(tmp_path):
    with Run.create(tmp_path, "ppo", Settings()) as run:
        for step in range(5):
            run.log(step, {"return": float(step)})
    with Run(run.folder, Settings(8), 2) as again:
        assert config.load(Settings, run.folder / "config.yaml") == Settings(8)
        assert steps(run.folder) == [0, 1, 2]
        again.log(3, {"return": 30.0})
    assert steps(run.folder) == [0, 1, 2, 3]
    assert read_metrics(run.folder)[-1]["return"] == 30.0
    assert (3, "return", 30.0) in scalars(run.folder)


def test_a_part_is_a_run_inside_a_run_and_goes_on_like_one(tmp_path):
    with Run.create(tmp_path, "whole", Settings()) as run:
        with run.part("first", 0, Settings(1)) as part:
            assert part.folder == run.folder / "first" and part.outermost == run.folder
            part.log(1, {"loss": 1.0})
            part.log(2, {"loss": 0.5})
        with run.part("first", 1, Settings(2)) as part:
            part.log(2, {"loss": 0.4})
        assert [line["loss"] for line in runs.read_metrics(part.folder)] == [1.0, 0.4]
        assert config.load(Settings, part.folder / "config.yaml") == Settings(2)
        assert runs.read_metrics(run.folder) == []


def test_a_torn_last_line_is_dropped(tmp_path):
    with Run.create(tmp_path, "ppo", Settings()) as run:
        run.log(1, {"return": 1.0})
    path = run.folder / runs.METRICS
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"step": 2, "retu')
    assert steps(run.folder) == [1]
    Run(run.folder, Settings(), 9).close()
    assert path.read_bytes() == whole


@pytest.mark.parametrize("line", ["{broken", "3", '{"return": 1}', '{"step": null}'])
def test_a_damaged_line_is_named(tmp_path, line):
    (tmp_path / runs.METRICS).write_text('{"step": 1}\n' + line + '\n{"step": 2}\n')
    with pytest.raises(RunError, match=r"metrics\.jsonl: line 2: expected a JSON object"):
        read_metrics(tmp_path)


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(RunError, match=r"metrics\.jsonl: cannot read"):
        Run(tmp_path, Settings(), 0)
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="file: cannot start a run there"):
        Run.create(tmp_path / "file", "ppo", Settings())


def test_a_full_disk_keeps_the_metrics_whole(tmp_path):
    run = Run.create(tmp_path, "ppo", Settings())
    run.log(1, {"return": 1.0})
    before = (run.folder / runs.METRICS).read_bytes()
    refused = pytest.raises(RunError, match=r"metrics\.jsonl: cannot append")
    with refused, run, full_disk(after=len(before) + 10):
        run.log(2, {"return": 2.0})
    assert (run.folder / runs.METRICS).read_bytes() == before


def test_a_full_disk_under_tensorboard_is_told(tmp_path):
    run = Run.create(tmp_path, "ppo", Settings())
    refused = pytest.raises(RunError, match="cannot write TensorBoard events")
    with refused, run, full_disk(after=1500):
        for step in range(10):
            run.log(step, {f"a_rather_long_name_of_a_metric_{i}": 0.0 for i in range(3)})
    assert steps(run.folder) == list(range(len(steps(run.folder))))


def test_an_interrupted_log_leaves_whole_lines(tmp_path, monkeypatch):
    run = Run.create(tmp_path, "ppo", Settings())
    run.log(1, {"return": 1.0})
    write = os.write

    def half(descriptor, data):
        write(descriptor, data[: len(data) // 2])
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "write", half)
    with pytest.raises(KeyboardInterrupt):
        run.log(2, {"return": 2.0})
    monkeypatch.undo()
    run.log(2, {"return": 2.0})
    assert steps(run.folder) == [1, 2]


def test_progress_is_plain_lines_without_a_terminal(capsys, monkeypatch):
    monkeypatch.setattr(runs, "SECONDS_BETWEEN_LINES", 3600.0)
    with Progress(2000, "training") as progress:
        for _ in range(4):
            progress.advance(500, "return 3.2")
    text = capsys.readouterr().out
    assert text.count("\n") == 1
    assert text.startswith("training 2,000/2,000  ")
    assert text.endswith("0 s left  return 3.2\n")


def test_progress_is_a_bar_on_a_terminal(capsys, monkeypatch):
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    with Progress(2000, "training") as progress:
        progress.advance(2000, "return 3.2")
    text = capsys.readouterr().out
    assert "\x1b[" in text
    assert "2,000/2,000" in text
    assert "return 3.2" in text


def test_progress_of_slow_work_says_how_long_each_takes(capsys, monkeypatch):
    clock = itertools.count(0.0, 25.0)
    monkeypatch.setattr(runs.time, "monotonic", lambda: next(clock))
    with Progress(20, "episodes") as progress:
        progress.advance()
    assert capsys.readouterr().out == "episodes 1/20  25 s each  475 s left\n"


def test_metrics_are_standard_json_lines(tmp_path):
    with Run.create(tmp_path, "ppo", Settings()) as run:
        run.log(1, {"return": 1})
    (line,) = (run.folder / runs.METRICS).read_text().splitlines()
    assert set(json.loads(line)) == {"step", "wall_time", "return"}


@dataclass(frozen=True)
class Tracked(Settings):
    runs: Path = Path("runs")
    resume: Path | None = None


def kept_offline(folder: Path, last: bytes) -> bytes:
    """What Weights & Biases keeps in a folder until it has a network: records, not compressed.

    A process of its own writes them, which may be a little behind: `last` is waited for.
    """
    (file,) = folder.glob("wandb/offline-run-*/*.wandb")
    for _ in range(200):
        if last in file.read_bytes():
            break
        time.sleep(0.1)
    return file.read_bytes()


def test_metrics_also_go_to_a_named_project_of_weights_and_biases(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="needs the extra `test`")
    monkeypatch.setenv("WANDB_MODE", "offline")
    with Run.begin(Tracked(runs=tmp_path), "ppo", project="driving") as run:
        run.log(10, {"episode_return": 1234.5})
        with run.part("gate", 0, Settings()) as part:
            part.log(1, {"gate_loss": 0.015625})
    whole, of_part = kept_offline(run.folder, b"1234.5"), kept_offline(part.folder, b"0.015625")
    assert b"driving" in whole and b"driving" in of_part
    assert b"episode_return" in whole and b"1234.5" in whole and b"gate_loss" not in whole
    assert b"gate_loss" in of_part and b"0.015625" in of_part
    assert read_metrics(run.folder)[0]["episode_return"] == 1234.5


def test_a_project_without_the_package_is_said_before_a_folder_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(trackers, "find_spec", lambda name: None)
    message = "wandb: expected the package for project 'driving', found none; pip install wandb"
    with pytest.raises(TrackingError, match=message):
        Run.begin(Tracked(runs=tmp_path), "ppo", project="driving")
    assert not list(tmp_path.iterdir())


def test_pytorch_is_not_imported_but_can_be(tmp_path):
    (tmp_path / "torch.py").write_text("here = True")
    program = (
        "import sys, vertiwm_jax.runs; assert 'torch' not in sys.modules; "
        "import torch; assert torch.here"
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)
