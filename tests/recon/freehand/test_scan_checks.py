"""Are images in another order, or upside down, told, and sweeps that look odd left alone?"""

import numpy as np
import pytest
from scipy import ndimage

from recon.freehand import scan_checks

COUNT = 40


def sweep(rng, smooth=3.0, face=True, noise=10.0):
    """Images of a medium that changes along the sweep : (n, 96, 80) uint8, and their places, 0.5 mm apart."""
    medium = ndimage.gaussian_filter(rng.standard_normal((COUNT, 96, 80)), (smooth, smooth, smooth), mode="wrap")
    images = 110 + 30 * medium / medium.std() + noise * rng.standard_normal(medium.shape)
    if face:
        images[:, :3] = 220
    places = np.tile(np.diag([0.1, 0.1, 1.0, 1.0]), (COUNT, 1, 1))
    places[:, 2, 3] = 0.5 * np.arange(COUNT)
    return np.clip(images, 0, 255).astype(np.uint8), places


def told(images, places):
    return list(scan_checks.faults(images, places))


def test_a_sweep_is_no_fault_and_images_in_another_order_are(rng):
    """Also where some poses are lost, and the sweep is scanned backwards."""
    images, places = sweep(rng)
    places[5:8] = np.nan
    assert told(images, places) == [] and told(images[::-1], places[::-1]) == []
    (line,) = told(images[rng.permutation(COUNT)], places)
    assert "another order" in line


def test_a_few_images_in_another_order_are_told_and_noisy_poses_are_not(rng):
    """Ten of 2 mm apart, by an order of which none is in its place; and poses with more noise than steps."""
    images, places = sweep(rng, smooth=6.0)
    few = images[::4], places[::4]
    assert told(*few) == []
    (line,) = told(few[0][[5, 2, 9, 0, 7, 3, 8, 1, 6, 4]], few[1])
    assert "another order" in line
    along = places.copy()
    along[:, 2, 3] *= 0.4
    along[:, :3, 3] += rng.normal(0, 0.3, (COUNT, 3))
    assert told(images, along) == []


@pytest.mark.parametrize("smooth", [0.0, 30.0])
def test_images_of_which_no_two_resemble_each_other_have_no_order(smooth, rng):
    """Speckle alone, anew in each image; and a medium that is the same all along, as a tube is."""
    images, places = sweep(rng, smooth=0.0)
    if smooth:
        images = np.clip(images.mean(axis=0) + 10 * rng.standard_normal(images.shape), 0, 255).astype(np.uint8)
    assert told(images[rng.permutation(COUNT)], places) == []


def test_poses_that_shift_the_images_otherwise_than_they_show_are_told(rng):
    """A sweep across the planes whose poses say that it went along them; one that really went along them is right."""
    images, places = sweep(rng, noise=3.0)
    along = places.copy()
    along[:, 0, 3], along[:, 2, 3] = along[:, 2, 3], 0
    (line,) = told(images, along)
    assert "the poses shift B-scans 1 mm apart by 1 mm within their own planes" in line
    wide = ndimage.gaussian_filter(rng.standard_normal((96, 80 + 5 * COUNT)), 3.0)
    wide = np.clip(110 + 30 * wide / wide.std(), 0, 255).astype(np.uint8)
    assert told(np.stack([wide[:, 5 * k : 5 * k + 80] for k in range(COUNT)]), along) == []


def test_frozen_images_are_told(rng):
    """Those of a grabber that takes each image six times are as old as it is slow; images of nothing are alike."""
    images, places = sweep(rng)
    assert told(images[np.arange(COUNT) // 6], places) == []
    images[20:] = images[20]
    (line,) = told(images, places)
    assert line.startswith("20 B-scans in a row are the same")
    resting = places.copy()
    resting[20:] = places[20]
    assert told(images, resting) == []
    images[20:] = 0
    assert told(images, places) == []


def test_the_probes_face_at_the_bottom_is_told(rng):
    """Not without a face, nor where a scanner draws a bar at both ends."""
    images, places = sweep(rng)
    (line,) = told(images[:, ::-1], places)
    assert "upside down?" in line
    bars = images.copy()
    bars[:, -3:] = 220
    assert told(bars, places) == told(sweep(rng, face=False)[0][:, ::-1], places) == []
