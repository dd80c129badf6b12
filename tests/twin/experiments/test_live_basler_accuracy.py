"""The rows of devices' clocks, in reduced form."""

import pytest

from twin.experiments import live_basler_accuracy
from twin.experiments.table_rows import Setup, measure


@pytest.mark.slow
def test_clocks_are_followed(rig, monkeypatch):
    """With the bars of all; one map of 60 may have an error of more than three standard deviations, normal ones do in 0.3 %."""
    for name, count in (("DRAWS", 60), ("STEPS", 60), ("LOAD_FRAMES", 30_000)):
        monkeypatch.setattr(live_basler_accuracy, name, count)
    assert not [row for row in measure(live_basler_accuracy.measurements(Setup(rig, {}))) if not row.ok]
