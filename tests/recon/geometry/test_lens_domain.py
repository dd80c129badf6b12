"""Where a lens model has a ray for each pixel: against closed forms of radial lenses, and by inversion."""

import numpy as np
import pytest

from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise
from recon.geometry.lens_domain import is_one_to_one

SIZE, FOCAL = (1280, 1024), 1200.0
MATRIX = np.array([[FOCAL, 0, 639.5], [0, FOCAL, 511.5], [0, 0, 1]])
CORNER = np.hypot(640, 512) / FOCAL


def lens(*distortion):
    return Camera(SIZE, MATRIX, np.array(distortion, float))


@pytest.mark.parametrize(("share", "sound"), [(0.97, False), (1.05, True)])
def test_a_fold_is_told_by_its_place(share, sound):
    """`r (1 + k r^2)` turns back at r = 1 / sqrt(-3 k), where it has come two thirds of the way: a share of the corner's."""
    k = -4 / 27 / (share * CORNER) ** 2
    assert is_one_to_one(lens(k, 0, 0, 0), margin=0) == sound


def test_a_margin_belongs_to_the_image():
    """A fold beyond the corner, but within a tenth of the sides."""
    folded = lens(-4 / 27 / (1.1 * CORNER) ** 2, 0, 0, 0)
    assert is_one_to_one(folded, margin=0) and not is_one_to_one(folded)


def test_a_pole_within_the_image_is_found():
    """Zeros of numerator and denominator side by side: far from both the quotient is nearly one."""
    near = 0.6 * CORNER
    torn = lens(-1 / near**2, 0, 0, 0, 0, -1 / (1.01 * near) ** 2, 0, 0)
    points = np.array([[1.3 * near * FOCAL, 0, FOCAL]])
    assert np.allclose(linearise(torn, points, ()).pixels, lens().project(points), atol=40)
    assert not is_one_to_one(torn, margin=0) and np.isnan(torn.project(points)).all()


def test_the_rigs_devices_are_sound(rig):
    """The projector's principal point lies beside its raster's lower edge."""
    assert all(is_one_to_one(device.optics.camera()) for device in (rig.cam1, rig.cam2, rig.projector))


def test_sound_lenses_are_those_whose_radius_rises_to_the_corner(rng):
    """120 radial lenses of any strength, against their radius alone; no case nearer to the border than the steps are fine."""
    radii, found = np.linspace(0, 4.5 * CORNER, 20000), []
    for _ in range(120):
        k = rng.normal(0, 0.4, 6) / CORNER ** np.array([2, 4, 6, 2, 4, 6])
        square = radii**2
        top, bottom = (1 + square * (a + square * (b + square * c)) for a, b, c in (k[:3], k[3:]))
        bent = radii * top / bottom
        end = int(np.argmax(bent > 1.002 * CORNER)) or radii.size
        rises = np.diff(bent[:end]).min() > 0 and end < radii.size
        if rises and np.diff(bent[:end]).min() < 0.1 * radii[1]:
            continue  # nearly folded: areas shrink to a few per cent, which isn't accepted either
        camera = lens(k[0], k[1], 0, 0, k[2], *k[3:])
        found.append((is_one_to_one(camera, margin=0), bool(rises)))
    assert len(found) > 80 and 16 < sum(rises for _, rises in found) < len(found) - 16
    assert [k for k, (one, rises) in enumerate(found) if one != rises] == []
