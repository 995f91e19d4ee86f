"""What the documentation shows is true: its examples run, and its commands exist."""

import importlib
import importlib.util
import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
from functools import partial, wraps
from pathlib import Path

import pytest
import tyro

from vertiwm_jax import config as configuration
from vertiwm_jax.cli import COMMANDS, main
from vertiwm_jax.mechanics import vehicle
from vertiwm_jax.rl.experiment import PPOTraining
from vertiwm_jax.simulators.collection import CollectConfig

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
ELSEWHERE = ("rclpy",)
"""What stands in blocks that only run on a robot."""
OPTIONAL = {
    "simulators.chrono": "pychrono",
    "stable_baselines3": "stable_baselines3",
    "rejax": "rejax",
}
"""What a block that says so needs, and is skipped without."""
LONG = (
    "MPPI",
    "vw.train",
    "stable_baselines3",
    "rejax",
    "SoilFilter",
    "jacfwd",
    "prediction_errors",
)
"""What stands in blocks that take more than a minute."""


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def examples():
    """Every Python block of every page."""
    for page in PAGES:
        for number, block in enumerate(blocks(page, "python"), 1):
            if any(word in block for word in ELSEWHERE):
                continue
            marks = [pytest.mark.slow] if any(word in block for word in LONG) else []
            if page.name == "README.md":
                marks = [pytest.mark.smoke]
            yield pytest.param(block, id=f"{page.stem}-{number}", marks=marks)


@pytest.mark.parametrize("block", list(examples()))
def test_every_example_runs_alone(block, tmp_path, monkeypatch):
    for word, module in OPTIONAL.items():
        if re.search(rf"^(from|import) \S*{word}", block, re.MULTILINE):
            pytest.importorskip(module)
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "example", "exec"), {"__name__": "example"})


def users():
    """The environment of who runs a command in a folder of his own."""
    own = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    return own | {"PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), own.get("PYTHONPATH")]))}


@pytest.mark.slow
def test_your_own_map_from_top_to_bottom(tmp_path, monkeypatch):
    """Every line as it stands, examples and commands, in a folder of its own: 15 minutes."""
    monkeypatch.chdir(tmp_path)
    run = "ppo-<date>-<time>"
    page = (ROOT / "docs/own-map.md").read_text(encoding="utf-8")
    for language, block in re.findall(r"```(\w+)\n(.*?)```", page, re.DOTALL):
        if language == "python":
            exec(compile(block, "own-map.md", "exec"), {"__name__": "example"})
            continue
        for line in block.splitlines():
            if run in line:
                line = line.replace(run, max(Path("runs").glob("ppo-*")).name)
            python, *rest = shlex.split(line)
            assert python == "python"
            subprocess.run([sys.executable, *rest], check=True, env=users())
    (trained,) = Path("runs").glob("ppo-*")
    assert {"summary.md", "learning_curves.png"} <= {file.name for file in trained.iterdir()}


def commands():
    """Every `python -m vertiwm_jax...` of a bash block, and the page that shows it."""
    for page in PAGES:
        for block in blocks(page, "bash"):
            for line in block.replace("\\\n", " ").splitlines():
                command = line.partition("#")[0].rpartition("&& ")[2].strip()
                if command.startswith("python -m vertiwm_jax"):
                    yield pytest.param(command, id=f"{page.name}: {command}")


FEW = "{updates: 1, updates_per_iteration: 1, warm_up: 0}"
TASK = """
ground: {train_worlds: 2, suites: [easy], suite_worlds: 1, starts: 8, pairs: 2}
model: builtin
navigation: {horizon_seconds: 3, settle_steps: 2}
action_repeat: 2
"""
SHORT = {
    "ppo.yaml": TASK
    + "ppo: {total_timesteps: 128, num_envs: 8, num_steps: 8, minibatches: 2, epochs: 1}",
    "sac.yaml": TASK
    + "sac: {total_timesteps: 256, num_envs: 8, num_steps: 8, learning_starts: 64, batch: 8}",
    "table.yaml": """
rows: [{algorithm: ppo, model: builtin}]
suites: [easy]
suite_worlds: 1
settings: .
""",
    "fit.yaml": f"""
windows: {{batch: 2, validation: 2}}
patches: {{batch: 2, validation: 2}}
transformer: {{autoencoders: {FEW}, single_steps: {FEW}, rollouts: {FEW}}}
nesam: {{autoencoders: {FEW}, single_steps: {FEW}, rollouts: {FEW}}}
soil: {FEW}
gate: {{rollouts: {FEW}}}
""",
}
"""Settings with which commands do all that they do, but little of it."""
SHORTENED = {
    "ppo": "--config ppo.yaml",
    "sac": "--config sac.yaml",
    "compare": "--config table.yaml",
    "collect": "--seconds 6 --kinds mixed --difficulties low --repeats 1",
    "fit": "--config fit.yaml",
    "evaluate prediction": "--stride 400",
    "evaluate floor": "--every 40",
    "evaluate navigation": "",
    "export": "",
    "view": "",
}
"""What makes the commands of docs/commands.md short."""


@pytest.mark.slow
def test_the_commands_one_after_the_other(tmp_path, monkeypatch):
    """Each in a folder of its own with what it names, shortened: 15 minutes."""
    monkeypatch.chdir(tmp_path)
    for name, settings in SHORT.items():
        Path(name).write_text(settings)
    shutil.copy("ppo.yaml", "my.yaml")
    (tmp_path / "data").symlink_to(ROOT / "data")
    (tmp_path / "MAPS").symlink_to(ROOT / "data" / "open" / "maps")
    env = users() | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "compiled")}
    done = []
    for shown in (found.values[0] for found in commands() if found.id.startswith("commands.md")):
        module = shown.split()[2].removeprefix("vertiwm_jax.")
        words = f"{module} {shown.split()[3]}" if module == "evaluate" else module
        whole = any(word in shown for word in ("--help", "--resume", "--config"))
        line = shown if whole else f"{shown} {SHORTENED[words]}"
        if "<date>" in line:
            line = line.replace("ppo-<date>-<time>", min(Path("runs").glob("ppo-*")).name)
        done.append(subprocess.run([sys.executable, *shlex.split(line)[1:]], env=env))
        assert done[-1].returncode == 0, line
    assert len(done) > 12


class Understood(Exception):
    """What a command line was read as."""


@pytest.fixture
def reading(tmp_path, monkeypatch):
    """Commands end once their arguments are read, in a folder that has what these name."""
    read = tyro.cli

    def only_read(kind, **kwargs):
        if inspect.isfunction(kind):  # It would be called with what is read.
            kind = wraps(kind)(lambda *args, **settings: (args, settings))
        raise Understood(read(kind, **kwargs))

    monkeypatch.setattr(tyro, "cli", only_read)
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "ppo-<date>-<time>"
    run.mkdir(parents=True)
    configuration.save(PPOTraining(), run / "config.yaml")
    configuration.save(PPOTraining(), tmp_path / "my.yaml")
    configuration.save(vehicle.load("rover"), tmp_path / "found.yaml")
    (tmp_path / "configs").symlink_to(ROOT / "configs")


@pytest.mark.parametrize("command", list(commands()))
def test_commands_are_understood(command, reading):
    _, _, module, *argv = shlex.split(command.replace("<date>-<time>", "'<date>-<time>'"))
    name = module.removeprefix("vertiwm_jax.")
    # A door of its own, or a module that is a command beside what else it is.
    run = partial(main, name) if name in COMMANDS else importlib.import_module(module).main
    if "--help" in argv:
        with pytest.raises(SystemExit) as stop:
            run(argv)
        assert stop.value.code == 0
        return
    with pytest.raises(Understood):
        run(argv)


def test_a_command_that_does_not_exist_would_be_found(reading):
    with pytest.raises(SystemExit) as stop:
        main("collect", ["--folder", "drives"])
    assert stop.value.code == 2
    with pytest.raises(Understood) as read:
        main("collect", ["--output", "drives"])
    assert read.value.args == (CollectConfig(Path("drives")),)
    assert len(list(commands())) > 20


def test_public_names_and_settings_are_told():
    pytest.importorskip("mkdocs", reason="needs the extra `docs`")
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    api = reference.api()
    for name in ("VehicleState", "rollout", "NavigationEnv"):
        assert f"\n### {name} " in api
    assert "* `position`: `[..., 3]`" in api
    assert "** in fit_chrono.yaml" in reference.configuration()
