"""Settings as the documentation shows them."""

import re
from pathlib import Path

import pytest

from vertiwm_jax import config
from vertiwm_jax.importers.settings import ImportSettings

PAGE = Path(__file__).parents[2] / "docs" / "own-data.md"
EXAMPLES = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("text", EXAMPLES, ids=["table", "planar", "skid", "rosbag"])
def test_examples_can_be_read(text, tmp_path):
    (tmp_path / "settings.yaml").write_text(text)
    settings = config.load(ImportSettings, tmp_path / "settings.yaml")
    assert settings.vehicle.wheelbase in (2.1, 0.512)
    assert (settings.table is None) != (settings.rosbag is None)
