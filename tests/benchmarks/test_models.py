import pytest

from benchmarks import models


@pytest.mark.integration
def test_batches_are_driven_by_as_many_devices_as_they_are_worth():
    found = models.rates("builtin", None, (1, 8))
    assert [figures["devices"] for figures in found.values()] == [1, 2]
    for batch, figures in zip((1, 8), found.values(), strict=True):
        assert figures["steps_per_s"] == batch * models.STEPS / figures["median_s"]
