"""The rows of the delay between scanner and cameras, at full size."""

import pytest

from twin.accuracy import clock_accuracy
from twin.accuracy.table_rows import Setup


@pytest.mark.slow
def test_lags(rig, scanners):
    """All lags within 5 ms, and intervals that hold them."""
    assert not [row for row in clock_accuracy.rows(Setup(rig, {}, None, scanners)) if not row.ok]
