"""A capture's surface as a scene: stripes, smoothing, and reflectance and room light against what was rendered."""

import numpy as np
import pytest

from recon.capture.surface_part import SurfaceCapture
from recon.model.patterns import Fringes, GrayCode, Patterns, Uniform
from recon.session import skin_step
from recon.structured_light.triangulate import PointMap
from scenes.catalogue import build_scene
from tests.twin.small_rigs import cropped
from twin.optics import seen_surface
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting, calibration_of, shoot


def test_stripes_are_those_of_the_code():
    """Two bits and the complementary one of 16 px: edges lie between pixels; uniform images have none."""
    parts = (Fringes(pitch=16, steps=8), GrayCode(pitch=16, bits=2, start=-0.5, complementary=True), Uniform(level=1))
    patterns = Patterns(projector_size=(64, 16), unwrap="gray", parts=parts)
    coarse, fine, finest, uniform = seen_surface.stripes(patterns)
    assert [one.number for one in (coarse, fine, finest, uniform)] == [8, 9, 10, 11]
    np.testing.assert_allclose(coarse.inside_px, np.arange(64) - 31.5)
    np.testing.assert_allclose(fine.inside_px[[0, 15, 16, 31, 32, 47, 48]], [-15.5, -0.5, 0.5, 15.5, 15.5, 0.5, -0.5])
    assert (fine.narrowest_px, finest.narrowest_px) == (32, 16)
    assert np.isposinf(uniform.inside_px).all()


def test_noise_of_a_plane_is_smoothed_to_small_slopes(rig, rng):
    """Slopes of some hundredths are left, twice what is asked for at most, and the plane stays where it is."""
    camera = cropped(rig.cam1, (160, 128)).optics.camera()
    rays = camera.pixel_rays()
    distance = 650 / rays[..., 2]
    step = 650 / camera.matrix[0, 0]
    sigma = 0.5 * step
    noisy = (distance + sigma * rng.standard_normal(distance.shape))[..., None] * rays + camera.centre
    points = PointMap(noisy.astype(np.float32), np.full(distance.shape, sigma, np.float32))
    smooth, inside = seen_surface.smoothed(points, camera)
    depth = smooth[..., 2]
    slopes = np.diff(depth, axis=1)[inside[:, 1:]] / step
    assert inside.mean() > 0.8 and slopes.std() < 2 * seen_surface.SLOPE
    assert abs(depth[inside].mean() - 650) < 0.02 and np.diff(noisy[..., 2], axis=1).std() / step > 0.5


@pytest.mark.slow
def test_reflectance_and_room_light_are_those_that_were_rendered(rig):
    """A sphere of 0.6 before a plane of 0.3, but for a factor that goes into the flux; and so the room's light over the flux."""
    small = rig.model_copy(update={"cam1": cropped(rig.cam1, (240, 192))})
    parts = (Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=7, complementary=True))
    patterns = Patterns(projector_size=small.projector.optics.size, unwrap="gray", parts=parts)
    tracing = Tracing(samples=16, room_lux=60)
    view = shoot(small, build_scene({"kind": "sphere"}), patterns, "cam1", tracing, Shooting(), 3)
    shots = SurfaceCapture(view.images, patterns, 8, calibration_of(small), "a sphere")
    seen = seen_surface.scene_of(shots, skin_step.reconstruct(shots), small, "cam1", view.exposure, tracing, 4)
    surface = seen.scene.things[0]
    near = surface.mesh.vertices[:, 2] < 648  # the sphere's front half
    scale = seen.rig.projector.radiant_flux_w / small.projector.radiant_flux_w
    ratio = np.median(surface.albedo[near]) / np.median(surface.albedo[surface.mesh.vertices[:, 2] > 700])
    assert ratio == pytest.approx(2, rel=0.02)
    assert np.median(surface.albedo[near]) * scale == pytest.approx(0.6, rel=0.02)
    assert seen.room_lux / scale == pytest.approx(60, rel=0.05)
