import json
from pathlib import Path

import numpy as np
import pytest

from vertiwm_jax.evaluation import floor
from vertiwm_jax.evaluation.floor import FloorTest
from vertiwm_jax.learning import dataset
from vertiwm_jax.learning.schema import DataError
from vertiwm_jax.mechanics.vehicle import HMMWV, load

DRIVES = Path(__file__).parents[1] / "data" / "chrono_drives"
CONTEXT = 3


def task(steps=12):
    recorded, terrain = dataset.load_drives(DRIVES, "train")
    return floor._task(recorded, terrain, 0, steps, np.random.default_rng(0))


@pytest.mark.integration
def test_the_second_vehicle_parts_after_the_context():
    given = task()
    offset = given[-1]
    assert np.linalg.norm(offset[:3]) == pytest.approx(1e-3)
    assert np.linalg.norm(offset[3:]) == pytest.approx(1e-3)
    first, second = floor.twice("builtin", load(HMMWV), CONTEXT, given)
    states = [np.stack([seen.state for seen in one.observations]) for one in (first, second)]
    assert len(states[0]) == len(states[1]) == 13
    np.testing.assert_array_equal(states[0][: CONTEXT + 1], states[1][: CONTEXT + 1])
    apart = np.linalg.norm((states[0] - states[1])[CONTEXT + 1 :, :3], axis=1)
    assert np.all((apart > 2e-4) & (apart < 1e-2))
    # They part by nothing else.
    still = floor.twice("builtin", load(HMMWV), CONTEXT, (*given[:-1], np.zeros(6)))
    for one, other in zip(still[0].observations, still[1].observations, strict=True):
        np.testing.assert_array_equal(one.state, other.state)


@pytest.mark.integration
def test_the_floor_is_told_as_prediction_errors_are(tmp_path):
    rows = tmp_path / "floor.json"
    test = FloorTest((DRIVES,), split="train", every=4, context=CONTEXT, horizons=(4, 8), json=rows)
    text = test.run()
    assert text.index("after 4 steps (0.4 s)") < text.index("after 8 steps (0.8 s)")
    told = [
        row
        for row in json.loads(rows.read_text())
        if (row["subset"], row["speed_bin"]) == ("all", None)
    ]
    # Nine drives, of which the first, the fifth and the ninth are driven.
    assert [(row["horizon"], row["windows"], row["vehicle"]) for row in told] == [
        (4, 3, "hmmwv"),
        (8, 3, "hmmwv"),
    ]
    assert all(1e-4 < row["position_m"] < 1e-2 for row in told)
    assert told[0]["model"] == "builtin, 1 mm and 1 mm/s apart"


@pytest.mark.integration
def test_drives_that_are_too_short_are_refused():
    with pytest.raises(DataError, match="expected drives of at least 503 steps"):
        FloorTest((DRIVES,), split="train", every=9, context=CONTEXT, horizons=(500,)).run()
