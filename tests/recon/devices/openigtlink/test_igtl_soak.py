import pytest

from benchmarks import live_igtl_soak


@pytest.mark.slow
def test_good_and_bad_clients_leave_nothing_behind():
    """Hundreds of frames at five times the rate of a rig, and two dozen bad clients; half an hour is run by hand.

    An image that is kept makes 0.3 MB of each.
    """
    soak = live_igtl_soak.run(seconds=8.0, rate_hz=100.0)
    assert soak.published > 200 and soak.images > 50 and soak.poses > 50
    assert soak.flat, live_igtl_soak.lines(soak)
