"""A B-scan lies live where it lies in a volume: by the same pose, the same lag, the same calibration."""

import numpy as np
import pytest

from recon.capture import sweep_part
from recon.devices.interfaces import Frame
from recon.freehand import scans
from recon.geometry import rigid
from recon.navigation.feeds import Arrival
from recon.navigation.placed_scans import WAITING, ScanPlacing
from tests.recon import probe_motions, sweep_sets

LAG_S = 0.05


@pytest.fixture(scope="module")
def sweep(rig, tmp_path_factory):
    """A sweep across a ball, 20 B-scans and 33 poses a second, with a lag."""
    return sweep_part.read_sweep(sweep_sets.ball(tmp_path_factory.mktemp("ball"), rig, LAG_S))


def arrival(image, number, time_ns):
    return Arrival(Frame(image, number, time_ns, time_ns), time_ns)


def live(sweep, lag_s):
    """All B-scans that are placed as poses and images come, in order of their times."""
    placing, placed = ScanPlacing(sweep.probe, lag_s), {}
    coming = [(int(time), 1, k) for k, time in enumerate(sweep.times)] + [
        (int(time), 0, k) for k, time in enumerate(sweep.track.times)
    ]
    for time, is_scan, k in sorted(coming):
        if is_scan:
            placing.add_scan(arrival(sweep.image(k), k, time))
        else:
            placing.add_pose(time, sweep.track.poses[k])
            if (scan := placing.newest()) is not None:
                placed[scan.number] = scan
    return placed


@pytest.mark.parametrize("lag_s", [LAG_S, 0.0])
def test_the_same_pixel_is_at_the_same_point_as_in_a_volume(sweep, lag_s):
    placed = live(sweep, lag_s)
    offline = scans.of_sweep(sweep, sweep.probe, lag_s, None)
    assert len(placed) > 0.9 * len(sweep.paths)
    pixels = np.array([[0, 0, 0], [79, 0, 0], [31, 64, 0], [0, 99, 0]], float)
    for number, scan in placed.items():
        there = rigid.apply(offline.world_from_pixel[number], pixels)
        np.testing.assert_allclose(rigid.apply(scan.world_from_pixel, pixels), there, atol=1e-6)
        np.testing.assert_array_equal(scan.image, sweep.image(number))


def test_the_newest_b_scan_is_placed_and_those_before_it_are_left_out(rig):
    placing = ScanPlacing(probe_motions.true_probe(rig), 0.0)
    image = np.zeros((4, 5), np.uint8)
    for k in range(5):
        placing.add_scan(arrival(image, k, 10_000_000 * k))
    for time in (0, 35_000_000):
        placing.add_pose(time, np.eye(4))
    assert placing.newest().number == 3, "the fourth came after the last pose"
    assert placing.newest() is None
    placing.add_pose(45_000_000, np.eye(4))
    assert placing.newest().number == 4


def test_a_b_scan_has_no_place_where_the_target_was_not_seen(rig):
    """Nor before the first pose, nor over a gap of more than a quarter of a second."""
    placing = ScanPlacing(probe_motions.true_probe(rig), 0.0)
    image = np.zeros((4, 5), np.uint8)
    placing.add_pose(100_000_000, np.eye(4))
    for time in range(140_000_000, 500_000_000, 40_000_000):
        placing.add_pose(time, np.full((4, 4), np.nan))
    placing.add_pose(500_000_000, np.eye(4))
    for time in (50_000_000, 300_000_000):
        placing.add_scan(arrival(image, 0, time))
    assert placing.newest() is None


def test_what_waits_is_bounded_and_a_clock_that_was_set_back_starts_anew(rig):
    placing = ScanPlacing(probe_motions.true_probe(rig), 0.0)
    image = np.zeros((4, 5), np.uint8)
    for k in range(10_000):
        placing.add_pose(40_000_000 * k, np.eye(4))
        placing.add_scan(arrival(image, k, 10**15 + k))
    assert len(placing._waiting) == WAITING and len(placing._poses) < 100
    placing.add_pose(0, np.eye(4))
    placing.add_pose(40_000_000, np.eye(4))
    placing.add_scan(arrival(image, 7, 20_000_000))
    assert placing.newest().number == 7


def test_corners_are_those_of_the_pixels_centres(rig):
    probe = probe_motions.true_probe(rig)
    placing = ScanPlacing(probe, 0.0)
    for time in (0, 10_000_000):
        placing.add_pose(time, np.eye(4))
    placing.add_scan(arrival(np.zeros((4, 5), np.uint8), 0, 5_000_000))
    expected = probe.to_target([[0, 0], [4, 0], [4, 3], [0, 3]])
    np.testing.assert_allclose(placing.newest().corners, expected, atol=1e-9)
