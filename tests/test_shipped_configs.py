"""The configurations that come with the package."""

from pathlib import Path

import pytest

from vertiwm_jax import config
from vertiwm_jax.evaluation import compare
from vertiwm_jax.evaluation.compare import CompareConfig
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.experiment import FitConfig
from vertiwm_jax.mechanics.vehicle import VehicleConfig
from vertiwm_jax.models import files
from vertiwm_jax.rl import experiment
from vertiwm_jax.rl.experiment import PPOTraining

FOLDER = Path(__file__).parents[1] / "configs"
KINDS = {"import_nedm": ImportSettings} | dict.fromkeys(["table3", "table3_paper"], CompareConfig)
KINDS |= dict.fromkeys(
    ["fit_chrono", "fit_paper", "fine_tune", "gates", "adapt", "any_vehicle"], FitConfig
)


@pytest.mark.parametrize("file", sorted(FOLDER.rglob("*.yaml")), ids=lambda file: file.stem)
def test_every_one_can_be_read(file):
    folders = {"rows": FitConfig, "vehicles": VehicleConfig}
    kind = folders.get(file.parent.name, KINDS.get(file.stem))
    loaded = config.load(kind, file) if kind else experiment.load(file)
    assert kind or loaded.name in file.stem


@pytest.mark.parametrize(
    ("name", "start"),
    [("fine_tune", "pretrained"), ("gates", "pretrained"), ("adapt", "any_vehicle")],
)
def test_what_goes_on_from_a_model_that_comes_along_is_of_its_form(name, start):
    settings = config.load(FitConfig, FOLDER / f"{name}.yaml")
    assert settings.start == Path(start)
    assert settings.model == files.load(files.find(start))[0]


@pytest.mark.parametrize("name", experiment.TRAININGS)
def test_what_is_not_set_is_as_in_the_file_of_the_algorithm(name):
    assert experiment.load(config.default_config(name)) == experiment.TRAININGS[name]()


def test_the_papers_trainings_are_the_papers():
    table = config.load(CompareConfig, config.default_config("table3_paper"))
    assert table.rows[0].model == "vertiwm"
    for row in table.rows:
        training = compare.training(table, row)
        task, schedule = training.navigation, training.schedule
        assert schedule.total_timesteps == 2_000 * 20 * 300
        assert (schedule.num_envs, schedule.num_steps) == (20, 300)
        assert training.action_repeat == 1 and training.base == "none"
        assert task.embeddings and not task.arcs and task.straight
        before_and_after = 2 * 4 * task.observed.size * getattr(schedule, "buffer_size", 0)
        assert before_and_after < 2e9  # bytes


@pytest.mark.parametrize("kind", [PPOTraining, FitConfig, CompareConfig])
def test_a_setting_that_is_gone_says_what_is_in_its_place(kind, tmp_path):
    file = tmp_path / "before.yaml"
    file.write_text("compile_cache: null\n")
    with pytest.raises(config.ConfigError, match="compile_cache: is now JAX_COMPILATION_CACHE_DIR"):
        config.load(kind, file)
