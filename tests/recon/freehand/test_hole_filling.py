"""Holes between slices are filled by what lies on both sides, and nothing grows beyond."""

import numpy as np
import pytest

from recon.files.volumes import Volume
from recon.freehand import hole_filling
from recon.freehand.volume_compounding import Reconstruction


def scanned(values, filled, spacing=(1.0, 1.0, 1.0)):
    voxels = np.where(filled, values, 0).astype(np.uint8)
    return Reconstruction(Volume(voxels, np.zeros(3), np.array(spacing)), filled)


@pytest.fixture
def ramp():
    """Grey levels that rise along all three axes, (12, 13, 14)."""
    k, j, i = np.indices((12, 13, 14))
    return 20 + 4 * i + 5 * j + 6 * k


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_ramp_between_slices_is_found_exactly(ramp, axis):
    filled = np.zeros(ramp.shape, bool)
    np.moveaxis(filled, axis, 0)[::4] = True
    result = hole_filling.fill_holes(scanned(ramp, filled))
    last = 4 * ((ramp.shape[axis] - 1) // 4)
    inside, outside = np.split(np.moveaxis(result.filled, axis, 0), [last + 1])
    assert inside.all() and not outside.any()  # nothing beyond the last slice
    assert np.array_equal(result.volume.voxels[result.filled], ramp[result.filled])


@pytest.mark.parametrize(("gap", "closed"), [(3, True), (7, True), (8, False)])
def test_only_gaps_within_the_limit_are_closed(gap, closed):
    """A stick of 9 voxels spans 7 empty ones."""
    filled = np.zeros((1, 1, gap + 2), bool)
    filled[..., [0, -1]] = True
    assert hole_filling.fill_holes(scanned(100, filled), most_voxels=9).filled.all() == closed


def test_what_was_scanned_stays(rng, ramp):
    noise = rng.integers(0, 256, ramp.shape)
    filled = rng.random(ramp.shape) < 0.3
    before = scanned(noise, filled)
    copy = before.volume.voxels.copy()
    after = hole_filling.fill_holes(before)
    assert np.array_equal(after.volume.voxels[filled], noise[filled]) and after.filled[filled].all()
    assert np.array_equal(before.volume.voxels, copy) and after.filled.sum() > filled.sum()


def test_the_shortest_stick_counts_in_mm_not_voxels():
    """Along x the next voxels are 2 mm away, along z 5 mm; with two sticks both count, the longer one less."""
    filled, values = np.zeros((3, 1, 3), bool), np.zeros((3, 1, 3))
    filled[1, 0, [0, 2]], values[1, 0, [0, 2]] = True, 200
    filled[[0, 2], 0, 1], values[[0, 2], 0, 1] = True, 60
    found = [hole_filling.fill_holes(scanned(values, filled, (2, 1, 5)), sticks=n).volume.voxels[1, 0, 1] for n in (1, 2)]
    assert found == [200, 160]  # (200 / 4 + 60 / 10) / (1 / 4 + 1 / 10)
