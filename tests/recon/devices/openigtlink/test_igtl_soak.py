import pytest

from benchmarks import live_igtl_soak


@pytest.mark.slow
def test_good_and_bad_clients_leave_nothing_behind():
    """A thousand frames at ten times the rate of a rig, and sixty bad clients; half an hour is run by hand."""
    soak = live_igtl_soak.run(seconds=15.0, rate_hz=100.0)
    assert soak.published > 500 and soak.images > 100 and soak.poses > 100
    assert soak.flat, live_igtl_soak.lines(soak)
