"""`python -m benchmarks.gpu` tells of all that it measures, and of what fails."""

import gzip
import json
import math
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from benchmarks import gpu


@pytest.fixture
def bench(tmp_path):
    return gpu.Benchmark(*gpu.sizes(small=True), tmp_path / "gpu.json", jax.devices()[0])


def numbers(found):
    if isinstance(found, dict | list):
        for x in found.values() if isinstance(found, dict) else found:
            yield from numbers(x)
    elif isinstance(found, int | float):
        yield found


@pytest.mark.slow
def test_small_run_measures_all_parts(tmp_path):
    file = tmp_path / "results" / "gpu.json"
    command = [sys.executable, "-m", "benchmarks.gpu", "--small", "--minutes", "20"]
    root = Path(gpu.__file__).parents[1]
    ran = subprocess.run(
        [*command, "--output", str(file)], cwd=root, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    found = json.loads(file.read_text())
    assert all(math.isfinite(x) for x in numbers(found))
    assert found["machine"]["device"].startswith("cpu")
    cases = {name: found[name]["cases"] for name in gpu.PARTS}
    assert not any("out_of_time" in found[name] for name in gpu.PARTS)
    assert not any("error" in case for of_part in cases.values() for case in of_part.values())

    config, models, vehicles, environments = gpu.sizes(small=True)
    assert len(cases["correctness"]) == len(cases["compile"]) == len(models) + 1
    for case in cases["correctness"].values():
        assert case["tolerances"] and all(
            case[name] <= limit for name, limit in case["tolerances"].items()
        )
    assert len(cases["steps"]) == len(models) * len(vehicles)
    for number in environments:
        case = cases["ppo"][f"{number} environments"]
        done = number * config.ppo.num_steps * config.action_repeat
        assert case["transitions_per_s"] == pytest.approx(done / case["median_s"])
        assert case["median_s"] >= case["min_s"] > 0 and case["calls"] >= 3
    assert all(case["compile_s"] > 0 for case in cases["compile"].values())

    profile = cases["profile"]["PPO"]
    spent = [row["ns"] for row in profile["longest"].values()]
    assert spent == sorted(spent, reverse=True) and len(spent) == gpu.LONGEST
    assert len(gzip.decompress((file.parent / profile["trace"]).read_bytes())) > 0

    for training, compiles in zip(cases["training"].values(), (True, False), strict=True):
        assert training["median_transitions_per_s"] > 0
        said = [line for _, line in training["said"]]
        assert any(line.startswith("| ppo ") for line in said)
        assert compiles == any(line.startswith("compiling for") for line in said)


def test_what_fails_is_one_line_and_the_rest_goes_on(bench, monkeypatch):
    def mixed(_):
        yield "breaks", lambda: {}["a\nb"]
        yield "differs", lambda: {"error": "beyond tolerance: median_m"}
        yield "works", lambda: {"steps_per_s": 2.0}

    def unprepared(_):
        raise RuntimeError("no room\nfor anything")
        yield

    monkeypatch.setattr(gpu, "PARTS", {"mixed": (mixed, 1), "unprepared": (unprepared, 1)})
    failed = gpu.run(bench, ["mixed", "unprepared"], 60, {"machine": {}})
    assert failed == ["mixed, breaks", "mixed, differs", "unprepared, preparing"]
    found = json.loads(bench.output.read_text())
    assert found["mixed"]["cases"]["works"] == {"steps_per_s": 2.0}
    assert found["mixed"]["cases"]["breaks"] == {"error": r"KeyError: 'a\nb'"}
    assert found["unprepared"]["cases"] == {"preparing": {"error": "RuntimeError: no room"}}


def test_cases_begin_while_there_is_time(bench, monkeypatch):
    def endless(_):
        while True:
            yield "again", lambda: {}

    monkeypatch.setattr(gpu, "PARTS", {name: (endless, 1) for name in ("first", "second")})
    assert not gpu.run(bench, ["first", "second"], 0.2, {})
    found = json.loads(bench.output.read_text())
    for name in ("first", "second"):
        assert found[name]["out_of_time"] and found[name]["cases"]
    assert 0.2 <= found["seconds"] < 5


@pytest.mark.integration
def test_differences_beyond_tolerance_and_nan_are_failures(bench, monkeypatch):
    cases = dict(gpu.correctness(bench))
    assert list(cases) == [f"{name}, default precision" for name in (*bench.models, "PPO")]
    for tolerance, beyond in ((0.0, False), (math.nan, True)):
        limits = dict.fromkeys(gpu.TOLERANCES["default"], tolerance)
        monkeypatch.setattr(gpu, "TOLERANCES", {"default": limits})
        for compared in cases.values():
            assert ("error" in compared()) == beyond
