"""`vertiwm evaluate`: how well a model predicts, and a policy drives."""

from collections.abc import Sequence

import tyro

from vertiwm_jax.evaluation.calibration import CalibrationTest
from vertiwm_jax.evaluation.prediction_report import PredictionTest
from vertiwm_jax.evaluation.report import NavigationTest

TESTS = {
    "prediction": PredictionTest,
    "calibration": CalibrationTest,
    "navigation": NavigationTest,
}


def run(name: str, words: Sequence[str]) -> None:
    test = tyro.extras.subcommand_cli_from_dict(
        TESTS,
        args=words,
        prog=f"vertiwm {name}",
        description=__doc__,
        config=(tyro.conf.FlagConversionOff,),
    )
    print(f"\n{test.run()}")
