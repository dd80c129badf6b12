"""The rows of devices' clocks, at full size."""

import pytest

from twin.accuracy import live_basler_accuracy
from twin.accuracy.table_rows import Setup, measure


@pytest.mark.slow
def test_clocks_are_followed(rig):
    assert not [row for row in measure(live_basler_accuracy.measurements(Setup(rig, {}))) if not row.ok]
