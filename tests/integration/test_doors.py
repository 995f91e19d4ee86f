"""The commands from end to end, on settings so small that compiling is all their cost."""

import csv
import json
import math
import os
import shutil
import signal
from dataclasses import replace

import chex
import jax
import numpy as np
import pytest
from doors import door, opened, refusal

from vertiwm_jax import checkpoints, machine, runs
from vertiwm_jax import config as configuration
from vertiwm_jax.deploy import run_policy
from vertiwm_jax.env.controllers import REFERENCE
from vertiwm_jax.env.observation import IMAGE_SHAPE, OBSERVATION_SIZE
from vertiwm_jax.env.task import NavigationConfig
from vertiwm_jax.env.termination import TerminationReason
from vertiwm_jax.evaluation import report
from vertiwm_jax.evaluation.report import NavigationTest
from vertiwm_jax.models import files as model_files
from vertiwm_jax.models.config import ModelConfig
from vertiwm_jax.models.registry import load_model
from vertiwm_jax.planning.improvement import ImprovementConfig
from vertiwm_jax.rl import experiment, risk
from vertiwm_jax.rl.experiment import PPOTraining
from vertiwm_jax.rl.policy import load_policy
from vertiwm_jax.runs import Run
from vertiwm_jax.terrain import files
from vertiwm_jax.terrain.map import TerrainMap
from vertiwm_jax.terrain.sensing import SensingConfig

GRASS = 3
TINY = """
ground: {train_worlds: 2, suites: [easy, obstacles], suite_worlds: 1, starts: 8, pairs: 2}
navigation: {horizon_seconds: 3, settle_steps: 2}
model: builtin
simulator: {substeps: 1}
action_repeat: 2
planning: {candidates: 2, decisions: 1, model: builtin}
ppo:
  {total_timesteps: 512, num_envs: 8, num_steps: 8, minibatches: 2, epochs: 1, hidden: [8],
   schedule: constant}
loop: {checkpoint_every: 2}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("doors")
    (folder / "tiny.yaml").write_text(TINY)
    return folder


@pytest.fixture(scope="module")
def train(folder):
    """Runs the door, with the tiny settings first; gives the newest run folder."""
    return opened(door("ppo"), folder, "--config", str(folder / "tiny.yaml"))


@pytest.fixture(scope="module")
def run(train):
    """A finished training."""
    return train()


def numbers(run):
    timed = ("wall_time", "timesteps_per_second")
    lines = runs.read_metrics(run)
    return [{name: line[name] for name in line if name not in timed} for line in lines]


def learned(run):
    config = experiment.load(run / "config.yaml")
    return experiment.learned(config, run)


@pytest.mark.smoke
def test_a_run_leaves_all_that_was_promised(run, folder):
    left = {path.name.split(".tfevents")[0] for path in run.iterdir()}
    assert left >= {
        "config.yaml", "metrics.jsonl", "events.out", "checkpoints", "policy",
        "learning_curves.png", "summary.md", "summary.json", "episodes.csv",
    }  # fmt: skip
    lines = runs.read_metrics(run)
    assert [line["step"] for line in lines] == [1, 2, 3, 4]
    # Steps of the environments, 64 actions an iteration that are held for two of them.
    assert [line["timesteps"] for line in lines] == [128, 256, 384, 512]
    assert all(np.isfinite(line["policy_loss"]) for line in lines)
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["2", "4"]
    summary = json.loads((run / "summary.json").read_text())
    assert list(summary) == ["easy", "obstacles"]
    for suite, rows in summary.items():
        policies = "ppo", "ppo with planning", "look ahead", "straight to goal", "random"
        assert tuple(rows) == policies
        assert (run / f"trajectories_{suite}.png").is_file()
        assert f"**{suite}**" in (run / "summary.md").read_text()
    assert sum(rows["ppo"]["tasks"] for rows in summary.values()) == 4
    asked = configuration.load(PPOTraining, folder / "tiny.yaml")
    assert configuration.load(PPOTraining, run / "config.yaml").ppo == asked.ppo


@pytest.mark.smoke
def test_resuming_is_as_if_never_stopped(run, train, monkeypatch):
    log = Run.log

    def stopping(self, step, metrics):
        log(self, step, metrics)
        if step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as stop:
        patch.setattr(Run, "log", stopping)
        train()
    assert stop.value.code == 130
    stopped = max(run.parent.iterdir(), key=lambda folder: folder.name)
    assert stopped != run and len(numbers(stopped)) == 3
    train("--resume", str(stopped))
    assert numbers(stopped) == numbers(run)
    chex.assert_trees_all_equal(learned(stopped), learned(run))
    assert (stopped / "summary.json").read_text() == (run / "summary.json").read_text()
    assert (stopped / "config.yaml").read_text() == (run / "config.yaml").read_text()


@pytest.mark.parametrize("name", ["sac", pytest.param("td3", marks=pytest.mark.slow)])
def test_other_algorithms_leave_the_same_and_resume(name, folder, tmp_path):
    settings = (
        "{total_timesteps: 384, num_envs: 8, num_steps: 8, updates: 1, batch: 8, buffer_size: 64, "
    )
    settings += "learning_starts: 64, hidden: [8]}"
    # Policies that also see the ground by the world model's encoders.
    tiny = TINY[: TINY.index("planning")].replace("settle_steps", "embeddings: true, settle_steps")
    tiny += f"{name}: {settings}\nloop: {{checkpoint_every: 2}}\n"
    (tmp_path / "tiny.yaml").write_text(tiny)
    train = opened(door(name), folder, "--config", str(tmp_path / "tiny.yaml"))
    run = train()
    assert run.name.startswith(name)
    assert [line["step"] for line in runs.read_metrics(run)] == [1, 2, 3]
    stopped = shutil.copytree(run, tmp_path / "stopped")
    shutil.rmtree(stopped / "checkpoints" / "3")
    train("--resume", str(stopped))
    assert numbers(stopped) == numbers(run)
    chex.assert_trees_all_equal(learned(stopped), learned(run))
    door("evaluate")(["navigation", "--policy", str(run), "--output", str(tmp_path / "found")])
    found = json.loads((tmp_path / "found" / "summary.json").read_text())
    assert found == json.loads((run / "summary.json").read_text())
    assert all(name in rows for rows in found.values())
    door("export")([str(run)])
    robot = run_policy.load(run / "export")
    assert robot(np.zeros(OBSERVATION_SIZE + math.prod(IMAGE_SHAPE))).shape == (2,)


def test_what_is_set_beside_resume_is_kept(run, train, tmp_path):
    again = shutil.copytree(run, tmp_path / "again")
    before = (again / "config.yaml").read_text()
    message = refusal(door("ppo"), "--resume", again, "--ppo.hidden", 16)
    assert "actor" in message and "16]" in message and "8]" in message
    assert (again / "config.yaml").read_text() == before
    train("--resume", str(again), "--ppo.total-timesteps", "640")
    assert [line["step"] for line in numbers(again)] == [1, 2, 3, 4, 5]
    config = configuration.load(PPOTraining, again / "config.yaml")
    assert config.ppo.total_timesteps == 640 and config.resume is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ppo: {learnin_rate: 1}", "ppo.learnin_rate: unknown key, expected one of"),
        ("ppo: {epochs: many}", "ppo.epochs: expected int, found 'many' (str)"),
        (
            "ppo: {minibatches: 7}",
            "ppo: minibatches: expected minibatches * grad_accumulation, 7, to",
        ),
        ("loop: {seeds: 0}", "loop: seeds: expected at least 1, found 0"),
    ],
)
def test_bad_settings_are_named(tmp_path, capsys, text, words):
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(SystemExit) as stop:
        door("ppo")(["--config", str(file)])
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert f"error: {file}: {words}" in message and message.count("\n") == 1


def test_bad_worlds_are_named(folder, tmp_path):
    tiny = ("--config", folder / "tiny.yaml", "--runs", tmp_path / "runs")
    assert "nowhere" in refusal(door("ppo"), *tiny, "--terrain", tmp_path / "nowhere")
    maps(tmp_path / "maps", count=2)
    message = refusal(door("ppo"), *tiny, "--terrain", tmp_path / "maps")
    assert "held_out_every: expected at most the 2 worlds found" in message
    (tmp_path / "maps" / "map_0.npz").write_bytes(b"no archive")
    assert "map_0.npz" in refusal(door("ppo"), *tiny, "--terrain", tmp_path / "maps")
    assert not (tmp_path / "runs").exists()


def test_runs_that_cannot_be_are_named(run, folder, tmp_path):
    (tmp_path / "file").touch()
    tiny = ("--config", folder / "tiny.yaml")
    message = refusal(door("ppo"), *tiny, "--runs", tmp_path / "file")
    assert "file: cannot start a run there" in message
    damaged = shutil.copytree(run, tmp_path / "damaged")
    (damaged / "metrics.jsonl").write_text("{broken\n")
    assert "metrics.jsonl: line 1" in refusal(door("ppo"), "--resume", damaged)


def test_a_run_is_evaluated_as_at_its_end(run, tmp_path, capsys):
    door("evaluate")(["navigation", "--policy", str(run), "--output", str(tmp_path)])
    for name in ("summary.json", "episodes.csv"):
        assert (tmp_path / name).read_text() == (run / name).read_text()
    assert (run / "summary.md").read_text() in capsys.readouterr().out


def test_controllers_and_runs_on_other_worlds(run, tmp_path, capsys, monkeypatch):
    navigate = ["navigation", "--policy"]
    maps(tmp_path / "maps", count=2)
    given = ["--planning", "False", "--terrain", str(tmp_path / "maps")]
    door("evaluate")([*navigate, str(run), *given])
    said = capsys.readouterr().out
    assert "driving 4 tasks on 2 worlds" in said and "  straight to goal: " in said
    # The usual worlds are many.
    find = configuration.default_config
    found = {"ppo": run / "config.yaml"}
    monkeypatch.setattr(configuration, "default_config", lambda name: found.get(name) or find(name))
    door("evaluate")([*navigate, "straight", "--suites", "hard", "--seed", "7"])
    text = capsys.readouterr().out
    assert "**hard**" in text and "| straight to goal" in text
    assert "random" not in text and "Solved of" not in text
    door("evaluate")([*navigate, "random"])
    assert "| random" in capsys.readouterr().out
    small = ["--mppi.candidates", "2", "--mppi.decisions", "1", "--mppi.model", "builtin"]
    door("evaluate")([*navigate, "mppi", "--suites", "easy", *small])
    assert "| mppi" in capsys.readouterr().out


def test_risk_is_learned_kept_and_told(run, tmp_path, capsys, monkeypatch):
    own = shutil.copytree(run, tmp_path / "run")
    given = ["--policy", str(own), "--output", str(tmp_path / "told")]
    # What all of these episodes end with, after three seconds.
    monkeypatch.setattr(risk, "FAILURES", (TerminationReason.TIMED_OUT,))
    monkeypatch.setattr(risk, "_AHEAD", 15)
    monkeypatch.setattr(risk, "_UPDATES", 100)
    monkeypatch.setattr(risk.machine, "together", lambda cpu, accelerator: 16)
    door("evaluate")(["risk", *given, "--starts", "8", "--suite-worlds", "1"])
    table = capsys.readouterr().out
    assert "windows of 3 s" in table and "failed / foretold" in table
    assert (tmp_path / "told" / "risk.md").read_text().strip() in table
    assert (tmp_path / "told" / "risk.png").read_bytes()[:4] == b"\x89PNG"

    assert load_policy(run).risk is None
    config = experiment.load(own / "config.yaml")
    policies = {"ppo": load_policy(own).acting, REFERENCE: config.baselines[REFERENCE]}
    foretold = policies["ppo"].risk(np.zeros((3, OBSERVATION_SIZE)))
    assert foretold.shape == (3,) and np.all((foretold > 0) & (foretold < 1))
    worlds = experiment.held_out(config)
    groups = report.drive(config, worlds, policies, config.world_suites)
    report.write(tmp_path / "told", groups, worlds, 8.0)
    rows = list(csv.DictReader((tmp_path / "told" / "episodes.csv").open()))
    for row in rows:
        highest = row["highest_risk"]
        assert highest == "" if row["policy"] == REFERENCE else 0 < float(highest) < 1

    file = own / "policy" / "risk.npz"
    file.write_bytes(file.read_bytes()[:-100])
    message = refusal(door("evaluate"), "navigation", "--policy", own)
    assert f"{file}: cannot read weights" in message


@pytest.mark.slow
def test_planning_by_gradients(run, capsys, monkeypatch):
    find, found = configuration.default_config, {"ppo": run / "config.yaml"}
    monkeypatch.setattr(configuration, "default_config", lambda name: found.get(name) or find(name))
    small = ["candidates", "2", "improved", "1", "steps", "1", "decisions", "1", "model", "bicycle"]
    options = [f"--shooting.{x}" if i % 2 == 0 else x for i, x in enumerate(small)]
    door("evaluate")(["navigation", "--policy", "shooting", "--suites", "easy", *options])
    assert "| shooting" in capsys.readouterr().out


def test_how_far_sensors_see_can_be_asked_for(tmp_path):
    config = PPOTraining(navigation=NavigationConfig(sensing=SensingConfig(cells=40)))
    for asked, found in ((None, np.inf), (5.0, 5.0)):
        changed = NavigationTest("random", sensing_range=asked).changed(config).navigation
        assert changed == NavigationConfig(sensing=SensingConfig(range=found, cells=40))
    erring = NavigationTest("random", displaced=0.5, missing=0.1).changed(config).navigation
    assert erring.sensing == SensingConfig(cells=40, displaced=0.5, missing=0.1)
    sighted = replace(config, navigation=NavigationConfig(embeddings=True))
    configuration.save(sighted, tmp_path / "config.yaml")
    navigate = ("navigation", "--policy", tmp_path, "--sensing-range", "5")
    assert "sensing.range: expected inf with embeddings" in refusal(door("evaluate"), *navigate)


class Driven(Exception):
    """What was about to be driven."""


def about_to(monkeypatch, name):
    """Raises `Driven` where a function of the report would be called."""

    def drive(*arguments, **_):
        raise Driven(*arguments)

    monkeypatch.setattr(report, name, drive)


def test_a_policy_of_a_known_map_drives_on_one_that_is_revealed(run, monkeypatch):
    about_to(monkeypatch, "run_episodes")
    navigate = ["navigation", "--policy", str(run), "--suites", "easy", "--sensing-range", "12"]
    with pytest.raises(Driven) as found:
        door("evaluate")(navigate)
    env, params, policy, *_ = found.value.args
    assert env.config.sensing.range == 12.0 and params.starts.observed is not None
    assert policy.base is not None


@pytest.mark.parametrize("planning", [True, False, None])
def test_whether_a_policy_plans_can_be_asked_for(planning, run, tmp_path, monkeypatch):
    about_to(monkeypatch, "drive")
    (tmp_path / "policy").symlink_to(run / "policy")
    for of_run in (ImprovementConfig(candidates=3), None):
        config = replace(configuration.load(PPOTraining, run / "config.yaml"), planning=of_run)
        configuration.save(config, tmp_path / "config.yaml")
        asked = [] if planning is None else ["--planning", str(planning)]
        with pytest.raises(Driven) as found:
            door("evaluate")(["navigation", "--policy", str(tmp_path), *asked])
        policies = found.value.args[2]
        plans = bool(of_run) if planning is None else planning
        assert ("ppo with planning" in policies) == plans and "ppo" in policies
        if plans:
            assert policies["ppo with planning"].config == (of_run or ImprovementConfig())
    if planning is not None:
        with pytest.raises(ValueError, match="planning: is of the policy of a run, found mppi"):
            NavigationTest("mppi", planning=planning)


def test_a_policy_drives_another_vehicle(run, tmp_path, capsys):
    asked = ("--suites", "easy", "--planning", "False", "--output")
    navigate = ("navigation", "--policy", run, *asked)
    door("evaluate")([*map(str, navigate), str(tmp_path / "hmmwv")])
    door("evaluate")([*map(str, navigate), str(tmp_path / "rover"), "--vehicle", "rover"])
    assert "| straight to goal" in capsys.readouterr().out
    first, second = ((tmp_path / name / "episodes.csv").read_text() for name in ("hmmwv", "rover"))
    assert first != second
    message = refusal(door("evaluate"), *navigate, tmp_path / "rovr", "--vehicle", "rovr")
    assert "did you mean 'rover'" in message


def test_training_inside_a_world_model_and_judged_in_the_simulator(
    train, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(machine, "multiplies_bfloat16", lambda: True)
    config = ModelConfig()
    params = config.init_params(jax.random.key(0), load_model("builtin")[1])
    model_files.save(tmp_path / "model", config, params)
    varied = ["--variation.grip", "0.6", "1.0", "--variation.delay", "0", "2"]
    run = train("--model", "vertiwm", "--weights", str(tmp_path / "model"), *varied)
    expected = "training in vertiwm on 2 worlds, multiplying bfloat16"
    assert expected in capsys.readouterr().out
    # It goes on with what it began with, wherever that is.
    assert configuration.load(PPOTraining, run / "config.yaml").compute_dtype == "bfloat16"
    assert all(np.isfinite(line["policy_loss"]) for line in runs.read_metrics(run))
    door("evaluate")(["navigation", "--policy", str(run)])
    assert (run / "summary.md").read_text() in capsys.readouterr().out
    message = refusal(door("ppo"), "--model", "nesam", "--weights", tmp_path, "--runs", tmp_path)
    assert "model.yaml: no such file" in message


def test_policies_that_are_none_are_named(run, tmp_path):
    navigate = ("navigation", "--policy")
    message = refusal(door("evaluate"), *navigate, tmp_path / "none")
    assert message.endswith(f"found {tmp_path / 'none'}") and "folder of a run or one of" in message
    shutil.copy(run / "config.yaml", tmp_path)
    message = refusal(door("evaluate"), *navigate, tmp_path)
    assert message.endswith("expected the folder of a trained policy, found none")
    other = shutil.copytree(run / "policy", tmp_path / "policy") / "policy.yaml"
    other.write_text(other.read_text().replace("hidden: [8]", "hidden: [4]"))
    message = refusal(door("evaluate"), *navigate, tmp_path)
    assert "weights.npz: actor.params." in message and "as policy.yaml says" in message
    (tmp_path / "policy" / "weights.npz").write_bytes(b"no archive")
    assert "weights.npz: cannot read" in refusal(door("evaluate"), *navigate, tmp_path)
    newest = checkpoints.latest(run / "checkpoints")
    assert newest is not None and newest.name in ("4", "5")


def test_predictions_of_drives(tmp_path, capsys):
    drives(tmp_path, count=25, steps=24, speed=4.0)
    out, rows = tmp_path / "tables", tmp_path / "rows.json"
    argv = ["prediction", "--data", str(tmp_path), "--context", "2", "--horizons", "8", "4"]
    door("evaluate")([*argv, "--models", "builtin", "--output", str(out), "--json", str(rows)])
    text = capsys.readouterr().out
    assert "| constant velocity | 0.000 (0.000-0.000) |" in text
    assert text.index("after 4 steps (0.4 s)") < text.index("after 8 steps (0.8 s)")
    told = json.loads(rows.read_text())
    found = [row for row in told if row["horizon"] == 4 and row["speed_bin"] == "4-6"]
    models = ["builtin", "kinematic bicycle", "constant velocity"]
    assert [(row["model"], row["subset"]) for row in found] == [
        (model, subset) for model in models for subset in ("all", "rigid")
    ]
    # Three drives of the test split, two windows each, straight on at constant speed, 1.6 m.
    assert all((row["windows"], row["share_of_way"]) == (6, None) for row in found)
    assert found[0]["position_m"] < 0.1 and found[4]["position_m"] < 1e-4
    further = [row for row in told if row["horizon"] == 8 and row["model"] == models[2]]
    assert all(row["windows"] == 3 and row["share_of_way"] < 1e-4 for row in further)
    with (out / "prediction.csv").open() as file:
        assert [row["position_m"] for row in csv.DictReader(file)] == [
            str(row["position_m"]) for row in told
        ]
    text = (out / "prediction.md").read_text()
    assert "heading, rad" in text and "ground under the vehicle" in text
    for picture in ("prediction.png", "paths.png"):
        assert (out / picture).stat().st_size > 10_000
    # The naive rows need not be asked for.
    door("evaluate")([*argv, "--models", "builtin", "--vehicle", "rover", "--json", str(rows)])
    others = json.loads(rows.read_text())
    changed = {
        a["model"]: a["position_m"] != b["position_m"] for a, b in zip(told, others, strict=True)
    }
    assert changed == {"builtin": True, "kinematic bicycle": True, "constant velocity": False}
    assert "rovr" in refusal(door("evaluate"), *argv, "--vehicle", "rovr")


def test_bad_drives_are_named(tmp_path, capsys):
    predict = ("prediction", "--models", "builtin", "--data", tmp_path)
    assert "found none" in refusal(door("evaluate"), *predict)
    drives(tmp_path, count=25, steps=24, speed=4.0)
    message = refusal(door("evaluate"), *predict)
    assert "at least 32 steps in the test split, found at most 24" in message
    drives(tmp_path, count=2, steps=24, speed=4.0)
    assert "too few to share out" in refusal(door("evaluate"), *predict)
    predict += ("--context", "2", "--horizons", "4")
    drives(tmp_path, count=25, steps=24, speed=4000.0)
    assert "drives.npz: state: expected" in refusal(door("evaluate"), *predict)
    (tmp_path / "maps" / "map_0.npz").unlink()
    drives(tmp_path, count=25, steps=24, speed=4.0, with_map=False)
    assert "map_0.npz was expected" in refusal(door("evaluate"), *predict)
    capsys.readouterr()
    for argv in (["prediction"], ["predict"], ["prediction", "--data", ".", "--stride", "0"]):
        with pytest.raises(SystemExit) as stop:
            door("evaluate")(argv)
        assert stop.value.code == 2
    assert "stride: expected at least 1, found 0" in capsys.readouterr().err


def maps(folder, count):
    """Worlds of grass as procedural ones are in size, with a slope of their own each."""
    folder.mkdir()
    for i in range(count):
        elevation = np.broadcast_to(0.05 * i * np.arange(129.0), (129, 129))
        terrain = TerrainMap.from_array(elevation, np.full((16, 16), GRASS))
        files.save(terrain, folder / f"map_{i}.npz")


def drives(folder, count, steps, speed, with_map=True):
    """Straight drives at constant speed over level grass, as recorded ones are stored."""
    if with_map:
        shutil.rmtree(folder / "maps", ignore_errors=True)
        maps(folder / "maps", count=1)
    state = np.zeros((count, steps + 1, 12), np.float32)
    state[..., 0] = 0.1 * speed * np.arange(steps + 1)
    state[..., 2] = 0.45
    state[..., 6] = speed
    control = np.zeros((count, steps, 2), np.float32)
    control[..., 0] = speed
    np.savez(
        folder / "drives.npz",
        state=state,
        control=control,
        length=np.full(count, steps),
        wheel_class=np.full((count, steps + 1, 4), GRASS, np.uint8),
        meta=json.dumps({"map": "map_0.npz"}),
    )
