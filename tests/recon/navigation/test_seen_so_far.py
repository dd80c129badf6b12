"""The live map: the same as that of the whole sweep, and places that vanish as they are seen."""

import numpy as np
import pytest
import trimesh

from recon.geometry import rigid
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.seen_so_far import Mapper, RunningMap
from recon.segmentation import insonation, seen_map
from recon.segmentation.detectability import Sought
from tests.recon.navigation.live_stand_ins import until
from tests.recon.pose_stacks import SHAPE, stack, sweep

GREY = np.full(SHAPE, 90, np.uint8)
DOWN = rigid.transform(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), [0, 0, 600])  # the beam away from camera 1


def scans(matrices, image=GREY):
    return [PlacedScan(image, number, number, matrix) for number, matrix in enumerate(matrices)]


def flat_skin(half_mm=(40.0, 45.0)):
    """A plane at the array's face, around the middle of it."""
    x, z = (np.linspace(-half, half, 61) for half in half_mm)
    points = np.stack([*np.meshgrid(x + 20, z), np.zeros((61, 61))], axis=-1)[..., [0, 2, 1]].reshape(-1, 3)
    a = np.arange(61 * 61).reshape(61, 61)
    corners = [a[:-1, :-1], a[:-1, 1:], a[1:, :-1], a[1:, :-1], a[:-1, 1:], a[1:, 1:]]
    return trimesh.Trimesh(rigid.apply(DOWN, points), np.stack(corners, axis=-1).reshape(-1, 3), process=False)


@pytest.mark.parametrize("apart_mm", [0.0, 130.0])
def test_the_running_map_is_that_of_the_whole_sweep(apart_mm, rng):
    """In another order, too, and though its grid grows: a second stroke lies far beside the first."""
    matrices = sweep(rng, 40)
    matrices[20:, 0, 3] += apart_mm
    live = RunningMap()
    for scan in scans(matrices):
        live.add(scan)
    at_once = insonation.begin(live.tally.grid, SHAPE)
    for matrix in matrices[rng.permutation(len(matrices))]:
        insonation.add(at_once, matrix, GREY)
    for one, other in zip((*live.tally.sums, live.tally.marks), (*at_once.sums, at_once.marks), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    maps = [seen_map.probability(insonation.insonation(tally), Sought(), 0.8) for tally in (live.tally, at_once)]
    np.testing.assert_allclose(*maps, atol=1e-4)


def test_points_vanish_as_they_are_seen():
    """Under a skin the planned volume stays, the share rises, and points lie where no B-scan was."""
    live = RunningMap(flat_skin())
    matrices = DOWN @ stack(np.arange(-30, 30.1, 0.5))
    shares, planned = [0.0], set()
    for number, scan in enumerate(scans(matrices)):
        live.add(scan)
        if number % 40 == 0:
            found = live.seen()
            shares.append(found.share)
            planned.add(found.planned_mm3)
    assert len(planned) == 1 and (np.diff(shares) >= 0).all() and 0.15 < shares[-1] < 0.6
    local = rigid.apply(np.linalg.inv(DOWN), live.seen().points.astype(float))
    amid = (np.abs(local[:, 0] - 20) < 12) & (np.abs(local[:, 2]) < 22)
    assert not amid.any() and len(local) > 100, "all amid the sweep is seen, from below the ringing to the lower end"
    assert local[:, 1].min() > 3 and local[:, 1].max() < 40 and local[:, 0].max() > 45


def test_without_a_skin_what_lies_around_counts():
    """A B-scan alone sees no mass whole; a stroke does, and beside it is still to be scanned."""
    live = RunningMap()
    assert live.seen() is None
    matrices = stack(np.arange(-15, 15.1, 0.5))
    live.add(scans(matrices)[0])
    assert live.seen().share == 0
    for scan in scans(matrices)[1:]:
        live.add(scan)
    found = live.seen()
    assert 0.1 < found.share < 0.6
    assert found.points[:, 0].max() > 42 and found.points[:, 2].min() < -18


def test_a_b_scan_of_another_size_or_without_tissue_adds_nothing():
    live = RunningMap()
    for scan in scans(stack(np.arange(-15, 15.1, 0.5))):
        live.add(scan)
    before = live.tally.sums.count.copy()
    live.add(PlacedScan(np.full((80, 80), 90, np.uint8), 1, 1, stack([0])[0]))
    live.add(PlacedScan(np.zeros(SHAPE, np.uint8), 1, 1, stack([0])[0]))
    np.testing.assert_array_equal(live.tally.sums.count, before)


def test_a_thread_maps_all_that_it_is_given():
    mapper = Mapper(RunningMap())
    assert mapper.newest is None
    mapper.start()
    for scan in scans(stack(np.arange(-15, 15.1, 0.5))):
        mapper.add(scan)
    until(lambda: mapper.newest is not None)
    mapper.stop()
    assert mapper.running.tally.sums.count.sum() > 0
    assert mapper.newest.share == mapper.running.seen().share


def test_a_map_that_is_too_large_ends_and_nothing_else(monkeypatch, caplog):
    monkeypatch.setattr(insonation, "LIMITS", insonation.SeeingLimits(most_voxels=10))
    mapper = Mapper(RunningMap())
    mapper.start()
    mapper.add(scans(stack([0]))[0])
    until(lambda: "isn't mapped any more: map of what was seen: expected at most 10 voxels" in caplog.text)
    mapper.stop()
    assert mapper.newest is None
