"""The rows of devices' clocks, in reduced form."""

import pytest

from tests.twin.experiments.asked import missed
from twin.experiments import live_basler_accuracy as clocks


@pytest.mark.slow
def test_clocks_are_followed():
    """With the bars of all; one map of 60 may have an error of more than three standard deviations, normal ones do in 0.3 %."""
    for delays in clocks.DELAYS:
        assert not missed(clocks.maps, clocks.maps(None, delays, draws=60), delays=delays)
    assert not missed(clocks.jumps, clocks.jumps(None, clocks=60)) and not missed(clocks.load, clocks.load(None, frames=30_000))
