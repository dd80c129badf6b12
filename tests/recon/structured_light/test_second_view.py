"""Two cameras under the same fringes: less noise, as predicted; what deceived one is left out; nothing is lost."""

from dataclasses import replace

import numpy as np
import pytest

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.structured_light import second_view
from recon.structured_light.second_view import View
from recon.structured_light.triangulate import triangulate
from tests.recon.fringe_scenes import projector_map

SIZE, SIGMA_PX = (240, 180), 0.03
PATCH = np.s_[80:110, 100:140]


def device(name: str, x: float, focal: float, size=SIZE) -> Camera:
    """A device that stands x mm aside and looks at the middle of the scene, 650 mm away."""
    turn = rigid.from_rotation_vector([0.0, np.arctan2(x, 650.0), 0.0], [0.0, 0.0, 0.0])
    matrix = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    return Camera(size, matrix, np.array([-0.1, 0.05, 0, 0, 0]), turn @ rigid.transform(np.eye(3), [-x, 0, 0]), name)


CAMERA, BESIDE, PROJECTOR = device("cam1", 0, 700), device("cam2", 160, 700), device("projector", -170, 1500, (960, 600))


def seen(camera: Camera) -> np.ndarray:
    """Places : (h, w, 3) mm on a slanted plane."""
    normal, rays = np.array([0.1, -0.2, 1.0]), camera.pixel_rays()
    return camera.centre + rays * ((650 - camera.centre @ normal) / (rays @ normal))[..., None]


def view(camera: Camera, rng, used: Camera | None = None) -> View:
    """What a camera decodes of the plane, with noise, and its points by another calibration of it."""
    columns = PROJECTOR.project(seen(camera))[..., 0] + SIGMA_PX * rng.standard_normal(SIZE[::-1])
    found = projector_map(columns.astype(np.float32), None, np.full(SIZE[::-1], SIGMA_PX, np.float32))
    return View(used or camera, found, triangulate(found, used or camera, PROJECTOR))


@pytest.fixture
def views(rng) -> tuple[View, View]:
    return view(CAMERA, rng), view(BESIDE, rng)


def along(points: np.ndarray) -> np.ndarray:
    """Errors : (h, w) mm along camera 1's rays."""
    return np.sum((points - seen(CAMERA)) * CAMERA.pixel_rays(), axis=-1)


def test_both_measure_with_less_noise_as_predicted(views):
    """Errors over their sigma are standard normal, one camera's as both cameras'; neighbours share noise, so few are counted."""
    fused = second_view.fuse(*views, PROJECTOR)
    noises = []
    for points in (views[0].raw, fused.points):
        normal = (along(points.points) / points.sigma)[fused.shared][::5]
        assert abs(normal.std() - 1) < 5 / np.sqrt(2 * normal.size)
        assert abs(normal.mean()) < 5 / np.sqrt(normal.size)
        noises.append(along(points.points)[fused.shared].std())
    assert fused.shared.mean() > 0.5 and not fused.apart.any()
    assert noises[1] < 0.6 * noises[0]


def test_what_deceives_one_camera_is_left_out(views):
    """A patch whose columns camera 1 sees 0.5 px off: gloss, or light from elsewhere; all around it stays."""
    columns = views[0].found.columns.copy()
    columns[PATCH] += 0.5
    found = replace(views[0].found, columns=columns)
    deceived = View(CAMERA, found, triangulate(found, CAMERA, PROJECTOR))
    fused = second_view.fuse(deceived, views[1], PROJECTOR)
    assert fused.apart[PATCH].mean() > 0.99 and np.isnan(fused.points.points[PATCH][fused.apart[PATCH]]).all()
    fused.apart[PATCH] = False
    assert not fused.apart.any()


def test_what_the_second_camera_does_not_see_stays_the_first_ones(views):
    columns = views[1].found.columns.copy()
    columns[:, : SIZE[0] // 2] = np.nan
    fused = second_view.fuse(views[0], View(BESIDE, replace(views[1].found, columns=columns), views[1].raw), PROJECTOR)
    hidden = ~fused.shared
    assert 0.3 < hidden.mean() < 0.8
    assert np.array_equal(fused.points.points[hidden], views[0].raw.points[hidden])
    assert np.array_equal(fused.points.sigma[hidden], views[0].raw.sigma[hidden])


def test_calibrations_that_contradict_each_other_change_nothing(views, rng):
    """Camera 2 by a principal point 0.4 px off."""
    matrix = BESIDE.matrix.copy()
    matrix[0, 2] += 0.4
    fused = second_view.fuse(views[0], view(BESIDE, rng, replace(BESIDE, matrix=matrix)), PROJECTOR)
    assert fused.bias_px > second_view.LIMITS.bias_px
    assert fused.points is views[0].raw and not fused.shared.any() and not fused.apart.any()


def test_alone_is_what_the_first_camera_lacks(views):
    """A hole in camera 1's points is filled by camera 2's, and by a rim of a pixel or two; nothing else is doubled."""
    points = views[0].raw.points.copy()
    points[PATCH] = np.nan
    more = second_view.alone(views[1], replace(views[0].raw, points=points), CAMERA)
    places = more.points[np.isfinite(more.points[..., 0])]
    at = np.rint(CAMERA.project(places)).astype(int)
    inside = ((at >= 0) & (at < SIZE)).all(axis=1)
    u, v = at[inside].T
    in_hole = np.isnan(points[v, u, 0])
    assert in_hole.sum() > 0.8 * 30 * 40
    near = np.zeros(SIZE[::-1], bool)
    near[77:113, 97:143] = True
    border = (u < 3) | (v < 3) | (u > SIZE[0] - 4) | (v > SIZE[1] - 4)
    assert (near[v, u] | border).all()
