import numpy as np
import pytest

from vertiwm_jax.evaluation import risk


def windows(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Foretold probabilities from 0.05 % to 90 %, and failures that come as often as they say."""
    rng = np.random.default_rng(0)
    probability = np.exp(rng.uniform(np.log(5e-4), np.log(0.9), number))
    return probability, rng.uniform(size=number) < probability


def test_each_range_is_told_apart():
    probability = np.array([0.0005, 0.02, 0.02, 0.02, 0.02, 1.0])
    failed = np.array([False, True, False, False, False, True])
    low, middle, high = risk.rows(probability, failed)
    assert [row["windows"] for row in (low, middle, high)] == [1, 4, 1]
    assert (middle["foretold"], middle["mean"]) == ("1.0%-3.0%", "2.00%")
    assert (middle["failed"], middle["failed / foretold"]) == ("25.00%", "12.50")
    assert high["foretold"] == "60.0%-100.0%"  # A certainty is told, too.


def test_true_probabilities_have_ratios_near_one_and_skill():
    probability, failed = windows(100_000)
    for row in risk.rows(probability, failed):
        if float(row["mean"][:-1]) > 0.3:
            assert float(row["failed / foretold"]) == pytest.approx(1, abs=0.25)
    text = risk.told(probability, failed)
    assert text.startswith(f"100,000 windows of 3 s; {failed.sum():,} ({failed.mean():.2%}) have")
    assert float(text.split()[-1][:-1]) == pytest.approx(
        1 - np.mean(probability * (1 - probability)) / (failed.mean() * (1 - failed.mean())),
        abs=0.02,
    )
    constant = np.full(len(failed), failed.mean())
    assert risk.told(constant, failed).endswith("Brier skill over this share: 0.00.")
    assert "skill" not in risk.told(constant, np.zeros(len(failed)))


def test_the_picture_has_a_dot_for_each_range():
    figure = risk.picture({"ppo": windows(10_000)})
    (axes,) = figure.axes
    foretold, share = axes.containers[0].lines[0].get_data()
    assert len(foretold) == len(risk.EDGES) - 1
    assert np.all(np.diff(foretold) > 0)
    np.testing.assert_allclose(share[2:], foretold[2:], rtol=0.4)
