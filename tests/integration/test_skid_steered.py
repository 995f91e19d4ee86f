"""From wheel speeds of a skid-steered robot to its prediction."""

import numpy as np
import pytest

from vertiwm_jax.evaluation.prediction_report import PredictionTest
from vertiwm_jax.importers.imports import import_drives
from vertiwm_jax.learning.schema import DataError

SETTINGS = """
vehicle: {wheelbase: 0.512, track: 0.5708, wheel_radius: 0.165, steered: skid, scale: 2.8}
units: {speed: 0.165}
table: {time: time, position: [x, y], yaw: yaw, left: left, right: right}
plane: concrete
"""


def test_logs_of_a_robot_are_predicted_with_its_vehicle_alone(tmp_path):
    time = 0.05 * np.arange(400)
    speed, turn = 0.5 * np.sin(time), 1.5 * np.cos(time)
    yaw = np.cumsum(0.05 * turn / 3)
    x, y = np.cumsum(0.05 * speed * np.cos(yaw)), np.cumsum(0.05 * speed * np.sin(yaw))
    sides = [(speed + side * turn * 0.5708 / 2) / 0.165 for side in (-1, 1)]
    columns = np.stack([time, x, y, yaw, *sides], axis=1)
    head = {"header": "time,x,y,yaw,left,right", "comments": "", "delimiter": ","}
    np.savetxt(tmp_path / "log.csv", columns, **head)
    (tmp_path / "settings.yaml").write_text(SETTINGS)
    drives = tmp_path / "drives"
    import_drives([tmp_path / "log.csv"], drives, tmp_path / "settings.yaml")
    test = dict(data=(drives,), split="all", models=("transformer",), context=8)
    table = PredictionTest(**test, vehicle="husky").run()
    rows = {line.split("|")[2].strip() for line in table.splitlines() if line.startswith("| all")}
    assert rows == {"builtin", "differential drive", "constant velocity"}
    with pytest.raises(DataError, match="vehicle: expected one skid-steered"):
        PredictionTest(**test, vehicle="hmmwv").run()
