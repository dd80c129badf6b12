"""Blur of beam and slice, by which bent borders move, and its correction."""

import numpy as np
import pytest
import trimesh
from scipy import ndimage
from scipy.special import ndtr

from recon.freehand.volume_compounding import Grid
from recon.geometry.surface_tree import signed_distances
from recon.segmentation import blur_correction, echo_power
from recon.segmentation.blur_correction import Blur, Planes, corrected, echoes
from recon.segmentation.echo_power import Placed
from recon.segmentation.mass_surface import Mass, distances
from recon.segmentation.masses import refined
from twin.ultrasound import beam
from twin.ultrasound.transducer import Transducer

GRID = Grid((60, 60, 60), np.array([-15.0, 0.0, -15.0]), np.full(3, 0.5), np.eye(3))
MIDDLE = np.array([0.0, 15.0, 0.0])
COLUMNS, ROWS, PIXEL_MM = 100, range(100), 0.3


def planes(blur, spacing_mm=0.5):
    """B-scans side by side, square to z."""
    matrices = np.tile(np.diag([PIXEL_MM, PIXEL_MM, 1.0, 1.0]), (round(28 / spacing_mm), 1, 1))
    matrices[:, :3, 3] = [[-15.0, 0.0, -14.0 + k * spacing_mm] for k in range(len(matrices))]
    return Planes(matrices, ROWS, COLUMNS, blur)


def ball(radius_mm):
    return Mass(trimesh.creation.icosphere(5, radius_mm).apply_translation(MIDDLE))


def lobed():
    """A body of 6 mm with bumps of 1.2 mm, some 3 mm wide at half their height."""
    sphere = trimesh.creation.icosphere(5)
    axes = trimesh.creation.icosahedron().vertices
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    radius = 6 + 1.2 * np.exp(24 * (sphere.vertices @ axes.T - 1)).sum(axis=1)
    return Mass(trimesh.Trimesh(MIDDLE + radius[:, None] * sphere.vertices, sphere.faces, process=False))


def half_level(power, direction):
    """Distance from the middle at which the power is half of tissue's."""
    along = np.arange(2, 8, 0.01)
    places = (MIDDLE + np.outer(along, direction) - GRID.origin) / 0.5
    levels = ndimage.map_coordinates(power, places[:, ::-1].T, order=1)
    return np.interp(0.5, levels, along)


def test_a_blurred_border_moves_by_half_of_its_curvature():
    """By trace(S K) / 2 more than an unblurred one in the same voxels."""
    sharp, wide = (echoes([ball(5.0)], GRID, planes(Blur(*sigmas))).volume.voxels for sigmas in ((0.0, ()), (0.4, ((0.0, 0.5),))))
    for direction, sigmas in (([0, -1, 0], (0.4, 0.5)), ([1, 0, 0], (0.0, 0.5))):
        moved = half_level(sharp, direction) - half_level(wide, direction)
        assert moved == pytest.approx(np.square(sigmas).sum() / (2 * 5.0), abs=0.012)


def test_echoes_are_those_of_a_plain_mean():
    """Of nine places of a beam, by SciPy."""
    blur = Blur(0.4, ((10.0, 0.3), (20.0, 0.9)))
    one = Planes(planes(blur).world_from_pixel[28:29], ROWS, COLUMNS, blur)
    found = echoes([ball(5.0)], GRID, one).volume.voxels
    field, (v, u) = distances([ball(5.0)], GRID).voxels, np.mgrid[:100, :100]
    places = np.stack([u, v, 0 * u], axis=-1) * PIXEL_MM + [-15.0, 0.0, 0.0]
    across = np.interp(PIXEL_MM * v, [10, 20], [0.3, 0.9])
    mean = np.zeros(v.shape)
    for a, first in zip((-np.sqrt(3), 0, np.sqrt(3)), (1 / 6, 2 / 3, 1 / 6), strict=True):
        for b, second in zip((-np.sqrt(3), 0, np.sqrt(3)), (1 / 6, 2 / 3, 1 / 6), strict=True):
            here = places + np.stack([0.4 * a + 0 * across, 0 * across, b * across], axis=-1)
            index = np.moveaxis((here - GRID.origin) / 0.5, -1, 0)[::-1]
            away = ndimage.map_coordinates(field, index, order=1, mode="constant", cval=6.0)
            mean += first * second * ndtr(away / blur_correction.EDGE_MM)
    pixels = Placed(*(field.astype(np.float32) for field in (mean, np.ones_like(mean), u, v)))
    expected = echo_power.accumulated([pixels], one.world_from_pixel, GRID).volume.voxels
    assert np.abs(found - expected).max() < 1e-3 and 100 < (1 - expected[30]).sum() < 1000


def test_lobes_are_as_high_as_they_are():
    """The fit alone takes a tenth of a millimetre off the tops of bumps that are blurred as in B-scans 1 mm apart."""
    true, blur = lobed(), Blur(0.2, ((8.0, 0.6), (25.0, 0.3)))
    scans = planes(blur, spacing_mm=1.0)
    power = echoes([true], GRID, scans)
    tops = np.linalg.norm(true.mesh.vertices - MIDDLE, axis=1) > 7.1
    found = refined([true], power, 3)
    better = corrected(found, power, scans, lambda masses, again: refined(masses, again, 3))
    low, mended = (-signed_distances(true.mesh.vertices[tops], one[0].mesh) for one in (found, better))
    assert np.mean(low) < -0.08
    assert abs(np.mean(mended)) < 0.4 * abs(np.mean(low))
    assert better[0].volume == pytest.approx(true.volume, rel=0.01)
    assert better[0].mesh.is_watertight


def test_the_default_slice_is_that_of_the_default_array():
    """Its thickness at some depths, in power, by diffraction."""
    depths = np.arange(4.0, Transducer().depth_mm, 2.0)
    amplitude = beam._elevation(Transducer(), depths)[0]
    power, offsets = np.abs(amplitude) ** 2, beam.STEP_MM * np.arange(amplitude.shape[1])
    sigma = np.sqrt((power * offsets**2).sum(axis=1) / power.sum(axis=1))
    assert np.abs(Blur().across(depths) - sigma).max() < 0.04


def test_a_border_beyond_the_images_end_stays():
    """Where the scanner's pixels reached and the made ones don't, nothing is known of the blur."""
    true, scans = ball(5.0), planes(Blur(0.2, ()))
    ends = Planes(scans.world_from_pixel, range(68), COLUMNS, scans.blur)  # 0.1 mm below the ball
    power = echoes([true], GRID, scans)
    (found,) = corrected([true], power, ends, lambda masses, again: refined(masses, again, 3))
    below = np.asarray(true.mesh.vertices)[:, 1] > 19.5
    assert np.abs(signed_distances(true.mesh.vertices[below], found.mesh)).max() < 0.2
