"""A capture's surface as a scene: stripes, smoothing, and reflectance and room light against what was rendered."""

from dataclasses import replace

import numpy as np
import pytest

from recon.capture.surface_part import SurfaceCapture
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.patterns import Fringes, GrayCode, Patterns, Uniform
from recon.session import skin_step
from recon.structured_light.decode import decode
from recon.structured_light.triangulate import PointMap
from scenes import solid_meshes
from scenes.catalogue import build_scene
from scenes.scene_types import Material, Scene, Thing
from tests.twin.small_rigs import cropped
from twin.optics import seen_surface
from twin.optics.light_transport import Tracing
from twin.optics.seen_surface import SeenLight
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


def test_light_of_clipped_stripes_is_that_of_the_fringes():
    """Where bright stripes are clipped, white is what the fringes' mean says of it, to a percent; elsewhere it stays.

    Bright stripes of 100 to 330 DN on a plane that sees two projector px a camera px, dark ones of 12 DN, and fringes that blur
    has left 0.45 of.
    """
    parts = (Fringes(pitch=16, steps=8), GrayCode(pitch=16, bits=6, complementary=True))
    patterns = Patterns(projector_size=(1024, 64), unwrap="gray", parts=parts)
    x = np.broadcast_to(60.3 + 2.37 * np.arange(320), (200, 320))
    albedo = np.broadcast_to(np.linspace(90, 320, 200)[:, None], x.shape)
    place = np.rint(x).astype(int)
    shown = [profile if binary else 0.5 + 0.45 * (profile - 0.5) for _, binary, profile in patterns.profiles()]
    images = np.array([12 + albedo * profile[place] for profile in shown])
    found = decode(np.clip(images, 0, 255).astype(np.uint8), patterns)
    light = seen_surface.seen_light(np.rint(np.clip(images, 0, 255)), patterns, found, 1.0, 255.0)
    known = np.isfinite(light.bright)
    assert known.mean() > 0.9 and known[-40:].mean() > 0.9
    np.testing.assert_allclose(light.bright[known], 12 + albedo[known], rtol=0.01)


def test_unknown_places_are_as_bright_as_what_is_near():
    """In a gap of 60 px, farther than any blur reaches, the values on either side; and dark light in proportion to the bright."""
    values = np.broadcast_to(np.where(np.arange(120) < 60, np.float32(0.2), np.float32(0.8)), (40, 120)).copy()
    values[:, 30:90] = np.nan
    np.testing.assert_allclose(seen_surface._filled(values)[:, [29, 40, 55, 64, 80, 90]], [[0.2, 0.2, 0.2, 0.8, 0.8, 0.8]] * 40)
    bright = np.broadcast_to(np.linspace(40, 100, 120, dtype=np.float32), (40, 120))
    dark = np.where(np.isnan(values), np.nan, np.float32(0.05) * bright)
    np.testing.assert_allclose(seen_surface._with_dark(SeenLight(bright, dark)).dark, 0.05 * bright, rtol=1e-5)


@pytest.mark.parametrize(
    ("truth", "light", "factor", "known_by"),
    [
        (0.6, 4.0, 0.6, "found"),
        (1.0, 4.0, 1.0, "found"),
        (0.0, 4.0, 0.0375, "or less"),
        (2.0, 4.0, 1.1875, "or more"),
        (0.6, 0.0, 1.0, "assumed"),
        (0.6, 1e-3, 1.0, "assumed"),
        (0.6, np.nan, 1.0, "assumed"),
    ],
)
def test_light_in_the_dark_gives_the_reflectance_or_nothing(rng, truth, light, factor, known_by):
    """Light between places from 0 to `light` DN aside from noise of 0.4 DN and blotches of 0.2 DN, which are alike over 10 px.

    The factor's standard deviation is below 0.02 where it is found. Without light that shows, and without any px that is known,
    the usual reflectance stays.
    """
    blotches = np.kron(rng.standard_normal((10, 12)), np.ones((10, 10)))
    once = np.float32(light) * np.linspace(0, 1, 120, dtype=np.float32) * np.ones((100, 1), np.float32)
    even, known = np.full(once.shape, 50, np.float32), np.ones(once.shape, bool)
    beyond = 3 + truth * once + truth**2 * 0.1 * once + 0.4 * rng.standard_normal(once.shape) + 0.2 * blotches
    found = seen_surface.reflectance_factor(np.float32(beyond), even, [once, 0.1 * once], known, bright=0.8, usual=0.8)
    assert found[1] == known_by and found[0] == pytest.approx(factor, abs=0.06)


@pytest.fixture(scope="module", params=[3, 5])
def plane(rig, request):
    """The rig, and a capture and the exposure of a plane of 0.6, in a room of 20 lux."""
    small = rig.model_copy(update={"cam1": cropped(rig.cam1, (160, 128))})
    parts = (Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=7, complementary=True))
    patterns = Patterns(projector_size=small.projector.optics.size, unwrap="gray", parts=parts)
    tracing = Tracing(samples=8, bounces=3, room_lux=20)
    view = shoot(small, build_scene({"kind": "plane"}), patterns, "cam1", tracing, Shooting(), request.param)
    return small, SurfaceCapture(view.images, patterns, 8, calibration_of(small), "a plane"), view.exposure


@pytest.mark.slow
def test_a_plane_keeps_the_usual_reflectance(plane):
    """Nothing is between places of a plane: 0.8 for its 0.6, and 0.8 / 0.6 of its flux and room light, to 3 %; and it says so."""
    small, shots, exposure = plane
    seen = seen_surface.scene_of(shots, skin_step.reconstruct(shots), small, "cam1", exposure, Tracing(samples=8, bounces=3), 4)
    scale = seen.rig.projector.radiant_flux_w / small.projector.radiant_flux_w
    assert seen.known_by == "assumed" and "assumed 0.8" in seen.reflectance_in_words
    assert np.median(seen.scene.things[0].albedo) * scale == pytest.approx(0.6, rel=0.02)
    assert seen.room_lux / scale == pytest.approx(20, rel=0.05) and scale == pytest.approx(0.75, rel=0.05)


@pytest.mark.slow
def test_a_surface_whose_white_is_clipped_is_refused(plane):
    """In one line that names the cause, where no bright stripe is below full scale; fringes may be as they like."""
    small, shots, exposure = plane
    binary = np.array([one for _, one, _ in shots.patterns.profiles()])[:, None, None]
    clipped = replace(shots, images=np.where(binary & (shots.images > 60), np.uint8(255), shots.images))
    skin = skin_step.reconstruct(shots)
    with pytest.raises(InputError, match=r"a plane: .* white is clipped") as raised:
        seen_surface.scene_of(clipped, skin, small, "cam1", exposure, Tracing(samples=4, bounces=1), 4)
    assert "\n" not in str(raised.value)


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


@pytest.mark.slow
@pytest.mark.parametrize(("bounces", "reflectance", "known_by"), [(3, 0.85, ("found", "or more")), (1, 0.0, ("or less",))])
def test_light_in_a_hollow_tells_the_reflectance(rig, bounces, reflectance, known_by):
    """A groove of 100 degrees and 0.85: found to 0.05, and as even as it is; where no light was reflected twice, it is black.

    No light between places, where one of the usual reflectance would have had it by many standard deviations, is evidence of a
    dark surface in strong light: so it is 0.03 or less, and not taken as usual. What two captures of noise leave is 0.03: the
    bound of 0.95 of its lightest twentieth.
    """
    small = rig.model_copy(update={"cam1": cropped(rig.cam1, (240, 192))})
    points, triangles = solid_meshes.grid((36.0, 28.0), (180, 140))
    deep = solid_meshes.slab(points, triangles, 30.0, -np.abs(points[:, 0]) / np.tan(np.radians(50)))
    groove = Thing("groove", solid_meshes.moved(deep, rigid.transform(np.eye(3), (0, 0, 665))), Material(0.85), smooth=False)
    parts = (Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=7, complementary=True))
    patterns = Patterns(projector_size=small.projector.optics.size, unwrap="gray", parts=parts)
    view = shoot(small, Scene("groove", (groove,)), patterns, "cam1", Tracing(samples=32, bounces=bounces), Shooting(), 3)
    shots = SurfaceCapture(view.images, patterns, 8, calibration_of(small), "a groove")
    again = Tracing(samples=16, bounces=3)
    seen = seen_surface.scene_of(shots, skin_step.reconstruct(shots), small, "cam1", view.exposure, again, 4)
    surface = seen.scene.things[0]
    aside = np.abs(surface.mesh.vertices[:, 0])
    assert seen.known_by in known_by and np.median(surface.albedo) == pytest.approx(reflectance, abs=0.05)
    ratio = np.median(surface.albedo[aside < 6]) / np.median(surface.albedo[aside > 11])
    assert ratio == pytest.approx(1, abs=0.03)
