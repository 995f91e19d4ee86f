"""`vertiwm evaluate`: how well a model predicts, and a policy drives."""

from typing import Annotated

import tyro

from vertiwm_jax import atomic
from vertiwm_jax.cli import arguments
from vertiwm_jax.evaluation.calibration import CalibrationTest
from vertiwm_jax.evaluation.floor import FloorTest
from vertiwm_jax.evaluation.prediction_report import PredictionTest
from vertiwm_jax.evaluation.report import NavigationTest
from vertiwm_jax.evaluation.risk import RiskTest

Test = (
    Annotated[PredictionTest, tyro.conf.subcommand("prediction")]
    | Annotated[FloorTest, tyro.conf.subcommand("floor")]
    | Annotated[CalibrationTest, tyro.conf.subcommand("calibration")]
    | Annotated[NavigationTest, tyro.conf.subcommand("navigation")]
    | Annotated[RiskTest, tyro.conf.subcommand("risk")]
)


def run(name: str, words: list[str]) -> None:
    off = (tyro.conf.FlagConversionOff,)
    test = arguments.read(Test, name, words, description=__doc__, config=off)
    for name, expect in (("output", atomic.expect_folder), ("json", atomic.expect_file)):
        if place := getattr(test, name, None):
            expect(place)
    print(f"\n{test.run()}")
