"""Two cameras under the same fringes: less noise, as predicted; what deceives one is left out; what hides a point is no fault."""

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
PLATE = ((-30.0, 20.0), (-35.0, 35.0))  # x and y, mm, of a plate before the plane


def on_plane(camera: Camera, normal: np.ndarray, depth_mm: float) -> np.ndarray:
    """Places : (h, w, 3) mm on a plane."""
    rays = camera.pixel_rays()
    return camera.centre + rays * ((depth_mm - camera.centre @ normal) / (rays @ normal))[..., None]


def seen(camera: Camera, plate_mm: float = 0.0) -> np.ndarray:
    """Places : (h, w, 3) mm on a slanted plane, or on a plate that stands so far before it."""
    places = on_plane(camera, np.array([0.1, -0.2, 1.0]), 650.0)
    if plate_mm:
        nearer = on_plane(camera, np.array([0.0, 0.0, 1.0]), 640.0 - plate_mm)
        (left, right), (top, bottom) = PLATE
        x, y = nearer[..., 0], nearer[..., 1]
        places = np.where(((x > left) & (x < right) & (y > top) & (y < bottom))[..., None], nearer, places)
    return places


def view(camera: Camera, rng, used: Camera | None = None, plate_mm: float = 0.0, sigma_px: float = SIGMA_PX) -> View:
    """What a camera decodes of the scene, with noise, and its points by another calibration of it. Shadows are lit, too."""
    columns = PROJECTOR.project(seen(camera, plate_mm))[..., 0] + sigma_px * rng.standard_normal(SIZE[::-1])
    found = projector_map(columns.astype(np.float32), None, np.full(SIZE[::-1], sigma_px, np.float32))
    return View(used or camera, found, triangulate(found, used or camera, PROJECTOR))


def deceived(of: View, off_px: float, patch=PATCH) -> View:
    """The view with a patch whose columns are wrong."""
    columns = of.found.columns.copy()
    columns[patch] += off_px
    found = replace(of.found, columns=columns)
    return View(of.camera, found, triangulate(found, of.camera, PROJECTOR))


@pytest.fixture
def views(rng) -> tuple[View, View]:
    return view(CAMERA, rng), view(BESIDE, rng)


def along(points: np.ndarray, camera: Camera = CAMERA, plate_mm: float = 0.0) -> np.ndarray:
    """Errors : (h, w) mm along a camera's rays."""
    return np.sum((points - seen(camera, plate_mm)) * camera.pixel_rays(), axis=-1)


def test_both_measure_with_less_noise_as_predicted(views):
    """Errors over their sigma are standard normal, one camera's as both cameras'; neighbours share noise, so few are counted."""
    fused = second_view.fuse(*views, PROJECTOR)
    noises = []
    for points in (views[0].raw, fused.first):
        normal = (along(points.points) / points.sigma)[fused.shared][::5]
        assert abs(normal.std() - 1) < 5 / np.sqrt(2 * normal.size)
        assert abs(normal.mean()) < 5 / np.sqrt(normal.size)
        noises.append(along(points.points)[fused.shared].std())
    assert fused.shared.mean() > 0.5 and not fused.apart.any()
    assert noises[1] < 0.6 * noises[0]


@pytest.mark.parametrize("off_px", [-1.0, 1.0, 12.0])
def test_what_deceives_the_first_camera_is_left_out(views, off_px):
    """Gloss, light from elsewhere, a wrong order: nothing wrong stays but for a rim, either way; all around it stays."""
    fused = second_view.fuse(deceived(views[0], off_px), views[1], PROJECTOR)
    wrong = np.abs(along(fused.first.points)) > 0.25 * abs(off_px)
    assert wrong[PATCH].mean() < 0.1
    around = np.ones(SIZE[::-1], bool)
    around[70:120, 70:170] = False
    assert not fused.apart[around].any()


@pytest.mark.parametrize("off_px", [-12.0, -1.0, 1.0, 12.0])
def test_what_deceives_the_second_camera_does_no_harm(views, off_px):
    """No wrong point of it joins the first one's, not even where these were left out."""
    second = deceived(views[1], off_px)
    fused = second_view.fuse(views[0], second, PROJECTOR)
    assert np.nanmax(np.abs(along(fused.first.points))) < 8 * np.nanmax(views[0].raw.sigma)
    more = second_view.alone(second._replace(raw=fused.second), fused.places, fused.first)
    wrong = np.abs(along(more.points, BESIDE)) > 8 * np.nanmax(views[1].raw.sigma)
    assert wrong.sum() < 0.05 * 30 * 40


@pytest.mark.parametrize("plate_mm", [15.0, 40.0])
def test_what_is_hidden_from_the_second_camera_stays(rng, plate_mm):
    """Behind a plate, which parts the cameras' views of the plane by many pixels: no fault of points, nor of calibrations."""
    first, second = view(CAMERA, rng, plate_mm=plate_mm), view(BESIDE, rng, plate_mm=plate_mm)
    fused = second_view.fuse(first, second, PROJECTOR)
    assert fused.shared.mean() > 0.4 and fused.bias_px < second_view.LIMITS.bias_px
    lost = np.isnan(fused.first.points[..., 0]) & np.isfinite(first.raw.points[..., 0])
    assert lost.mean() < 0.03  # along the plate's edge, some pixels wide
    kept = np.abs(along(fused.first.points, plate_mm=plate_mm))
    assert np.nanquantile(kept, 0.99) < 5 * np.nanmedian(first.raw.sigma)


def test_what_the_second_camera_does_not_see_stays_the_first_ones(views):
    columns = views[1].found.columns.copy()
    columns[:, : SIZE[0] // 2] = np.nan
    fused = second_view.fuse(views[0], View(BESIDE, replace(views[1].found, columns=columns), views[1].raw), PROJECTOR)
    hidden = ~fused.shared
    assert 0.3 < hidden.mean() < 0.8
    assert np.array_equal(fused.first.points[hidden], views[0].raw.points[hidden])
    assert np.array_equal(fused.first.sigma[hidden], views[0].raw.sigma[hidden])


def test_calibrations_that_contradict_each_other_change_nothing(views, rng):
    """Camera 2 by a principal point 0.4 px off."""
    matrix = BESIDE.matrix.copy()
    matrix[0, 2] += 0.4
    fused = second_view.fuse(views[0], view(BESIDE, rng, replace(BESIDE, matrix=matrix)), PROJECTOR)
    assert fused.bias_px > second_view.LIMITS.bias_px
    assert fused.first is views[0].raw and not fused.shared.any() and not fused.apart.any()


def test_noise_is_not_taken_for_calibrations_that_contradict_each_other(rng):
    """Ten times the usual noise: half a pixel of the projector's, where two cameras help most."""
    fused = second_view.fuse(view(CAMERA, rng, sigma_px=0.5), view(BESIDE, rng, sigma_px=0.5), PROJECTOR)
    assert fused.shared.mean() > 0.5


def test_points_without_sigma_are_weighed_alike(views):
    """As of maps without it: a pixel of the projector for both cameras, so that both together have less noise than one."""
    plain = [View(one.camera, replace(one.found, sigma_columns=None), one.raw) for one in views]
    plain = [one._replace(raw=triangulate(one.found, one.camera, PROJECTOR)) for one in plain]
    fused = second_view.fuse(*plain, PROJECTOR)
    assert np.isnan(fused.first.sigma).all()
    assert along(fused.first.points)[fused.shared].std() < 0.6 * along(views[0].raw.points)[fused.shared].std()


def test_alone_is_what_the_first_camera_lacks(views):
    """A hole in camera 1's points is filled by camera 2's, and by a rim of a pixel or two; nothing else is doubled."""
    points = views[0].raw.points.copy()
    points[PATCH] = np.nan
    fused = second_view.fuse(*views, PROJECTOR)
    more = second_view.alone(views[1], fused.places, replace(views[0].raw, points=points))
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
