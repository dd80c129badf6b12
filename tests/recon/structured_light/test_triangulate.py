"""Triangulation against points that were put there: synthetic projector maps of a known surface through strong lenses."""

from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise
from recon.structured_light.triangulate import PointMap, Triangulator, triangulate
from tests.recon.fringe_scenes import projector_map

SIZE = (160, 128)


def matrix(focal, centre):
    return np.array([[focal, 0, centre[0]], [0, focal * 1.003, centre[1]], [0, 0, 1]])


STRONG = [-0.25, 0.12, 0.002, -0.001, -0.03, 0.02, -0.01, 0.005, 0.003, -0.002, 0.002, 0.001, 0.03, -0.05]
CAMERA_POSE = rigid.from_rotation_vector([0.02, 0.05, -0.03], [10, -5, 20])
PROJECTOR_POSE = rigid.from_rotation_vector([0.09, -0.22, -0.04], [148.0, -68.0, 15.0])


@pytest.fixture(params=["ideal", "strong"])
def devices(request) -> tuple[Camera, Camera]:
    lens = np.array(STRONG if request.param == "strong" else [])
    camera = Camera(SIZE, matrix(400.0, (77.0, 66.0)), lens, CAMERA_POSE)
    return camera, Camera((1280, 800), matrix(1921.0, (614.0, 772.0)), lens, PROJECTOR_POSE)


def surface_points(camera: Camera) -> np.ndarray:
    """Hills of 30 mm about 660 mm away : (h, w, 3)."""
    u, v = np.moveaxis(camera.pixel_grid(), -1, 0)
    return camera.centre + (660 + 30 * np.sin(u / 20) * np.cos(v / 30))[..., None] * camera.rays(camera.pixel_grid())


def coordinates(points: np.ndarray, projector: Camera, axes: str) -> dict[str, np.ndarray]:
    pixels = projector.project(points)
    return {axis: pixels[..., i] for i, axis in enumerate(("columns", "rows")) if axis in axes}


def sigmas(shape, **sigma) -> dict[str, np.ndarray]:
    return {f"sigma_{axis}": np.full(shape, value) for axis, value in sigma.items()}


@pytest.mark.parametrize("axes", ["columns", "rows", "columns rows"])
def test_points_come_back(devices, axes):
    """To 1e-4 mm: float32 at 700 mm is 3e-5 mm, and 1e-6 projector px are 4e-7 mm."""
    camera, projector = devices
    points = surface_points(camera)
    sigma = sigmas(points.shape[:2], **dict.fromkeys(axes.split(), 0.02))
    result = triangulate(projector_map(**coordinates(points, projector, axes), **sigma), camera, projector)
    assert np.abs(result.points - points).max() < 1e-4


def test_no_point_is_found_past_the_projectors_turn(devices):
    """r (1 - 4 r^2) turns back at 0.29, within the picture: past it the projector has no ray, and a coordinate that is read there
    is another ray's.
    """
    camera, projector = devices[0], replace(devices[1], distortion=np.array([-4.0, 0, 0, 0]))
    points = surface_points(camera)
    pixels = linearise(projector, points.reshape(-1, 3), ()).pixels.reshape(*points.shape[:2], 2)
    seen = np.isfinite(projector.project(points)).all(axis=-1)
    assert 0.1 < seen.mean() < 0.9
    result = triangulate(projector_map(columns=pixels[..., 0], rows=pixels[..., 1]), camera, projector, "take").points
    known = np.isfinite(result).all(axis=-1)
    assert np.isfinite(projector.project(result[known])).all() and known[seen].mean() > 0.9
    assert np.abs(result - points)[known & seen].max() < 1e-2


def test_predicted_sigma_is_the_scatter_along_the_ray(devices):
    """A noisy decode of 20 480 pixels: z-scores standard normal, within 5 standard errors of mean and standard deviation."""
    camera, projector = devices
    points, rng = surface_points(camera), np.random.default_rng(1)
    truth = coordinates(points, projector, "columns rows")
    sigma = {"sigma_columns": np.full(points.shape[:2], 0.05), "sigma_rows": np.full(points.shape[:2], 0.02)}
    for axes in (("columns",), ("rows",), ("columns", "rows")):
        noisy = {axis: truth[axis] + rng.normal(0, sigma[f"sigma_{axis}"]) for axis in axes}
        result = triangulate(
            projector_map(**noisy, **{f"sigma_{axis}": sigma[f"sigma_{axis}"] for axis in axes}), camera, projector
        )
        along = ((result.points - points) * camera.rays(camera.pixel_grid())).sum(axis=-1)
        z = along / result.sigma
        assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size) and abs(z.mean()) < 5 / np.sqrt(z.size)


def test_the_better_axis_counts_more(devices):
    """With rows a thousand times as uncertain, two axes give what the columns alone give."""
    camera, projector = devices
    points, rng = surface_points(camera), np.random.default_rng(2)
    truth, shape = coordinates(points, projector, "columns rows"), points.shape[:2]
    both = truth | {"rows": truth["rows"] + rng.normal(0, 2, shape)}
    result = triangulate(projector_map(**both, **sigmas(shape, columns=0.01, rows=10.0)), camera, projector)
    assert np.abs(result.points - points).max() < 0.02


def test_a_pixel_with_one_axis_uses_that_one(devices):
    camera, projector = devices
    points = surface_points(camera)
    truth, shape = coordinates(points, projector, "columns rows"), points.shape[:2]
    truth["columns"][:, ::2] = np.nan
    truth["rows"][::2, 1::2] = np.nan
    truth["columns"][0, 1], truth["rows"][0, 1] = np.nan, np.nan
    result = triangulate(projector_map(**truth, **sigmas(shape, columns=0.02, rows=0.02)), camera, projector)
    assert np.isnan(result.points[0, 1]).all() and np.isnan(result.sigma[0, 1])
    known = np.isfinite(result.sigma)
    assert known.sum() == known.size - 1 and np.abs(result.points - points)[known].max() < 1e-4


def test_what_lies_behind_a_device_is_left_out(devices):
    """A column seen beyond infinity: the camera's ray and the projector's plane meet behind the camera."""
    camera, projector = devices
    far = camera.centre + 1e9 * camera.rays(camera.pixel_grid())
    beyond = (
        projector.project(far)[..., 0]
        + np.sign(projector.project(far)[..., 0] - projector.project(surface_points(camera))[..., 0]) * 40
    )
    result = triangulate(projector_map(columns=beyond, sigma_columns=np.full(beyond.shape, 0.02)), camera, projector)
    assert np.isnan(result.points).all() and np.isnan(result.sigma).all()


def test_one_triangulator_serves_many_maps(devices):
    camera, projector = devices
    points = surface_points(camera)
    one = Triangulator(camera, projector)
    for offset in (0.0, 1.0):
        given = projector_map(
            columns=coordinates(points, projector, "columns")["columns"] + offset, sigma_columns=np.full(points.shape[:2], 0.02)
        )
        fresh: PointMap = triangulate(given, camera, projector)
        assert np.array_equal(one(given).points, fresh.points) and np.array_equal(one(given).sigma, fresh.sigma)


def test_a_map_of_another_size_is_refused(devices):
    with pytest.raises(InputError, match=r"^triangulate: projector_map.columns: expected an image of .*, found \(20, 10\)"):
        triangulate(projector_map(columns=np.zeros((20, 10)), sigma_columns=np.ones((20, 10))), *devices)


def test_a_sigma_of_another_size_is_refused(devices):
    with pytest.raises(InputError, match=r"sigma_rows: expected an image of .*, found \(128, 10\)"):
        triangulate(projector_map(rows=np.zeros((128, 160)), sigma_rows=np.ones((128, 10))), *devices)


@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_a_camera_of_one_row_needs_one_axis_only(devices, axis):
    camera, projector = devices
    line = Camera((SIZE[0], 1), camera.matrix, camera.distortion, camera.camera_from_world)
    points = surface_points(line)
    result = triangulate(
        projector_map(**coordinates(points, projector, axis), **sigmas((1, SIZE[0]), **{axis: 0.02})), line, projector
    )
    assert np.abs(result.points - points).max() < 1e-4 and np.isfinite(result.sigma).all()


@pytest.mark.parametrize("axes", ["columns", "rows", "columns rows"])
def test_an_axis_without_sigma_gives_points_and_no_sigma(devices, axes):
    camera, projector = devices
    points = surface_points(camera)
    result = triangulate(projector_map(**coordinates(points, projector, axes)), camera, projector)
    assert np.abs(result.points - points).max() < 1e-4 and np.isnan(result.sigma).all()
