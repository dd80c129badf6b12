"""The twin's camera and projector against recon's camera model and the thin-lens formulas."""

import mitsuba as mi
import numpy as np
import pytest

from recon.geometry.camera import Camera
from recon.model.rig import Lens
from twin.experiments.optics_accuracy import LENSES
from twin.optics.instruments import CameraOptics, ProjectorOptics, light_point, sample_rays, transmission


@pytest.fixture
def strong(rig) -> Camera:
    """The rig's projector with strong distortion of all kinds."""
    ideal = rig.projector.optics.camera()
    return Camera(ideal.size, ideal.matrix, np.array(LENSES["strong"]), ideal.camera_from_world)


@pytest.fixture
def points(rng) -> np.ndarray:
    """Points of the working volume : (n, 3) mm."""
    return rng.uniform((-110, -90, 606), (110, 90, 713), (2000, 3))


def lit(optics: ProjectorOptics, points: np.ndarray, lens=(0.0, 0.0)):
    source, pixel, irradiance = light_point(optics, mi.Point3f(*np.float32(points.T)), mi.Point2f(*lens))
    return np.broadcast_to(np.asarray(source).T, points.shape), np.asarray(pixel).T, np.asarray(irradiance)


def test_projector_projects_as_recon_does(strong, points):
    """Through the lens's centre a point is lit by the pixel that recon's model projects it to (float32: 2e-3 px)."""
    _, pixel, _ = lit(ProjectorOptics(strong, 4.0, 655.0, 0.0, 1.0), points)
    np.testing.assert_allclose(pixel, strong.project(points), atol=2e-3)


def test_defocus_is_the_thin_lens(rig, points):
    """Lens points at the edge spread the light over a circle of D f |1/Zf - 1/Z| px."""
    ideal = rig.projector.optics.camera()
    pinhole = Camera(ideal.size, ideal.matrix, np.zeros(0), ideal.camera_from_world)
    optics = ProjectorOptics(pinhole, 5.8, 655.0, 0.0, 1.0)
    right, left = (lit(optics, points, lens)[1][:, 0] for lens in ((1.0, 0.0), (-1.0, 0.0)))
    depth = (points @ pinhole.camera_from_world[:3, :3].T + pinhole.camera_from_world[:3, 3])[:, 2]
    np.testing.assert_allclose(right - left, 5.8 * pinhole.matrix[0, 0] * (1 / 655 - 1 / depth), atol=2e-3)


def test_irradiance_is_the_flux_spread(rig):
    """The irradiance over a plane that faces the projector, summed over the raster's area, is the projector's flux."""
    optics = ProjectorOptics.of(
        rig.projector.model_copy(update={"lens": rig.projector.lens.model_copy(update={"vignetting": 0.0})})
    )
    ideal = Camera(optics.camera.size, optics.camera.matrix, np.zeros(0))
    u, v = np.meshgrid(np.arange(0, 1280, 8) + 3.5, np.arange(0, 800, 8) + 3.5)
    plane = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.linalg.inv(ideal.matrix).T * 650
    pinhole = ProjectorOptics(ideal, 0.0, 1.0, 0.0, optics.plane_irradiance)
    _, _, irradiance = lit(pinhole, plane)
    cosine = 650 / np.linalg.norm(plane, axis=1)
    area = (8 * 650) ** 2 / (ideal.matrix[0, 0] * ideal.matrix[1, 1])
    assert (irradiance * cosine * area).sum() == pytest.approx(rig.projector.radiant_flux_w, rel=1e-3)


def test_projector_lights_nothing_behind_it(rig):
    """A point behind the projector gets no light."""
    _, _, irradiance = lit(ProjectorOptics.of(rig.projector), np.array([[0.0, 0.0, -500.0]]))
    assert irradiance[0] == 0


def test_camera_rays_are_recons(rig, rng):
    """Through the lens's centre, rays at any offset within a pixel are recon's, as far as float32 carries."""
    camera = rig.cam2.optics.camera()
    strong = Camera(camera.size, camera.matrix, np.array(LENSES["strong"]), camera.camera_from_world)
    optics = CameraOptics(strong, 2.0, 660.0, 0.0, np.ones(camera.size[::-1], np.float32))
    offset = rng.uniform(-0.5, 0.5, 2)
    ray = sample_rays(optics, optics.tables, mi.Point2f(offset.tolist()), mi.Point2f(0, 0))
    expected = strong.rays(strong.pixel_grid() + offset).reshape(-1, 3)
    off_axis = np.linalg.norm(np.cross(np.asarray(ray.d, float).T, expected), axis=1)
    assert off_axis.max() * strong.matrix[0, 0] < 2e-3  # float32 directions: 1e-7 rad is 3e-4 px


def test_lens_points_meet_in_focus(rig):
    """Rays of one pixel through any lens point cross in the plane of focus."""
    optics = CameraOptics(rig.cam1.optics.camera(), 2.0, 660.0, 0.0, np.ones((1024, 1280), np.float32))
    crossings = []
    for lens in ((0.0, 0.0), (1.0, 0.0), (-0.6, 0.8)):
        ray = sample_rays(optics, optics.tables, mi.Point2f(0.0, 0.0), mi.Point2f(*lens))
        origin, direction = np.asarray(ray.o, float).T, np.asarray(ray.d, float).T
        crossings.append(origin + direction * ((660 - origin[:, 2]) / direction[:, 2])[:, None])
    np.testing.assert_allclose(crossings[1], crossings[0], atol=2e-4)
    np.testing.assert_allclose(crossings[2], crossings[0], atol=2e-4)


def test_transmission(rig):
    """Full on the axis; cos^4 times the vignetting in the corner."""
    camera = Camera((101, 101), np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), np.zeros(0))
    lens = Lens(focal_length_mm=16, f_number=8, focus_mm=660, vignetting=0.1)
    light = transmission(camera, lens)
    assert light[50, 50] == pytest.approx(1)
    assert light[0, 0] == pytest.approx(0.9 / (1 + 2 * 0.5**2) ** 2, rel=1e-5)
