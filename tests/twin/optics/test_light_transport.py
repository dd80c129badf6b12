"""Light transport against closed forms and against Mitsuba's own integrator."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.special import j1

from recon.geometry.camera import Camera
from recon.model.patterns import CentreLine, Fringes, Patterns
from scenes.catalogue import build_scene
from scenes.scene_types import Material, Scene, Thing
from tests.twin.small_rigs import cropped
from twin.experiments import optics_accuracy
from twin.experiments.experiment_setup import Setup
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import LUMENS_PER_WATT, Tracing, render
from twin.optics.mitsuba_reference import ideal_rig, mitsuba_scene, render_shown, show_pattern
from twin.optics.raster import Light
from twin.optics.ray_world import build_world

SMALL = Camera((64, 64), np.array([[400.0, 0, 31.5], [0, 400, 31.5], [0, 0, 1]]), np.zeros(0))
PROJECTOR = Camera((256, 256), np.array([[400.0, 0, 127.5], [0, 400, 127.5], [0, 0, 1]]), np.zeros(0))


def plate(z: float, reflectance: float = 0.6) -> Scene:
    mesh = trimesh.creation.box((1000, 1000, 2))
    mesh.apply_translation((0, 0, z + 1))
    return Scene("plate", (Thing("plate", mesh, Material(reflectance), smooth=False),))


def groove() -> Scene:
    """Two white walls that meet at a right angle along y, open towards the camera: light goes from one to the other."""
    walls = []
    for k, angle in enumerate((45, -45)):
        wall = trimesh.creation.box((200, 300, 2))
        wall.apply_translation((100, 0, 1) if k == 0 else (-100, 0, 1))
        wall.apply_transform(trimesh.transformations.rotation_matrix(np.deg2rad(angle), (0, 1, 0)))
        wall.apply_translation((0, 0, 650))
        walls.append(Thing(f"wall{k}", wall, Material(0.8), smooth=False))
    return Scene("groove", tuple(walls))


def uniform_light(blur_px: float = 0.0) -> Light:
    return Light(PROJECTOR.size, ("columns",), (np.ones(256, np.float32),), blur_px)


def test_plate_has_the_radiance_of_the_formula():
    """A Lambertian plate shows albedo/pi times the irradiance T / (z^2) cos(theta) ... of a pinhole projector, everywhere."""
    projector = ProjectorOptics(PROJECTOR, 0.0, 1.0, 0.0, 2.0)
    image = render(build_world(plate(500)), CameraOptics.pinhole(SMALL), projector, uniform_light(), Tracing(samples=4), seed=0)[
        0
    ]
    x, y = np.moveaxis((SMALL.pixel_grid() - 31.5) / 400, -1, 0)
    cosine = 1 / np.sqrt(1 + x * x + y * y)  # at the projector and at the plate: both look along z from the origin
    irradiance = 2.0 / (cosine * 500**2) * cosine  # T / (cos^3 d^2) with d = z / cos, times the plate's cosine
    np.testing.assert_allclose(image, 0.6 / np.pi * irradiance, rtol=2e-5)


def test_room_light_on_a_plate():
    """A plate in an even room of E lux shows albedo * E / pi; every sample has that value, so it is exact."""
    projector = ProjectorOptics(PROJECTOR, 0.0, 1.0, 0.0, 1e-12)
    tracing = Tracing(samples=4, room_lux=100)
    image = render(build_world(plate(500)), CameraOptics.pinhole(SMALL), projector, uniform_light(), tracing, seed=0)[0]
    np.testing.assert_allclose(image, 0.6 * 100 / LUMENS_PER_WATT * 1e-6 / np.pi, rtol=1e-4)


def test_gel_is_glossy_where_it_is():
    """Half of a plate is under gel: there its mirror image of the projector is brighter; elsewhere nothing changes."""
    projector = ProjectorOptics(PROJECTOR, 0.0, 1.0, 0.0, 2.0)
    dry = plate(500).things[0]
    mesh = dry.mesh.subdivide().subdivide().subdivide().subdivide().subdivide().subdivide()
    wet = np.float32(mesh.vertices[:, 0] > 0)
    dry = replace(dry, mesh=mesh, material=Material(0.05, roughness=0.4, ior=1.36))
    without, under = (
        render(
            build_world(Scene("plate", (thing,))), CameraOptics.pinhole(SMALL), projector, uniform_light(), Tracing(samples=4), 0
        )[0]
        for thing in (dry, replace(dry, wet=wet))
    )
    np.testing.assert_allclose(under[:, :28], without[:, :28], rtol=0.02)  # a texture of 1024 steps begins at half a step
    assert under[31, 36] > 3 * without[31, 36]


@pytest.mark.parametrize("depth", [560.0, 600.0, 655.0, 720.0])
def test_defocus_lowers_the_modulation_as_a_disc_does(depth):
    """Out of focus, fringes keep 2 J1(x)/x of their modulation, x = pi c / pitch, c the blur circle's diameter in px."""
    pitch, aperture, focus = 16.0, 16.0, 640.0
    patterns = Patterns(projector_size=(256, 256), unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=pitch, steps=4)))
    profiles = tuple(np.float32(profile) for _, _, profile in patterns.profiles())
    light = Light((256, 256), ("columns",) * 5, profiles, 0.6)
    world = build_world(plate(depth))

    def modulation(diameter: float) -> float:
        projector = ProjectorOptics(PROJECTOR, diameter, focus, 0.0, 1.0)
        i = render(world, CameraOptics.pinhole(SMALL), projector, light, Tracing(samples=256), seed=2)[1:].astype(float)
        return float(np.mean(np.hypot(i[0] - i[2], i[1] - i[3]) / i.sum(axis=0)))

    x = np.pi * aperture * 400 * abs(1 / focus - 1 / depth) / pitch
    expected = 2 * j1(x) / x
    assert modulation(aperture) / modulation(0.0) == pytest.approx(expected, abs=0.004)


@pytest.fixture(scope="module", params=["plane", "breast"])
def renders(rig, request):
    """Ours and Mitsuba's: the centre line and two fringe images at an eleventh of the size, 2000 blocks of pixels in all."""
    return optics_accuracy.both_renders(
        rig, build_scene({"kind": request.param}), 0.09, samples=32, repeats=8, patterns=(0, 2, 5)
    )


def test_patterns_match_mitsuba(renders):
    """Pinholes and direct light: the difference to Mitsuba's path integrator is its Monte Carlo error and no more."""
    z = optics_accuracy.z_scores(*renders)
    # Student's t with 7 degrees of freedom (Mitsuba's samples have nearly all of the variance) has a spread of 1.18
    assert z.std() < 1.1 * np.sqrt(7 / 5)
    assert abs(z.mean()) < 0.1
    assert (np.abs(z) > 8).mean() < 2e-3


def test_one_per_cent_would_be_seen(renders):
    """The same comparison fails if our light is wrong by 1 %."""
    ours, peer = renders
    assert optics_accuracy.z_scores(1.01 * ours, peer).mean() > 1


def test_interreflection_matches_mitsuba(rig):
    """In a white groove, light of four reflections is Mitsuba's, and clearly more than direct light."""
    camera, projector = ideal_rig(rig, 0.0625)
    light = Light.of(optics_accuracy.paper_surface(projector.camera.size), rig.projector)
    world, peer_world = build_world(groove()), mitsuba_scene(groove(), camera, projector, 16)
    direct = render(world, CameraOptics.pinhole(camera), projector, light, Tracing(samples=64), 0)[3].mean()
    ours = [
        render(world, CameraOptics.pinhole(camera), projector, light, Tracing(samples=64, bounces=4), k)[3].mean()
        for k in range(6)
    ]
    show_pattern(peer_world, light, 3)
    peer = [render_shown(peer_world, 128, k, bounces=4).mean() for k in range(6)]
    error = np.sqrt((np.var(ours, ddof=1) + np.var(peer, ddof=1)) / 6)
    assert np.mean(ours) > 1.1 * direct
    assert abs(np.mean(ours) - np.mean(peer)) < 5 * error
    assert error < 0.01 * np.mean(peer)  # so that the agreement says something


def test_phase_error_of_the_renderer(rig):
    """16 samples a pixel leave a phase error below 0.005 projector px on a noise-free plane, lenses and distortion included.

    In a quarter of the image, from near a corner to the middle.
    """
    part = rig.model_copy(update={"cam1": cropped(rig.cam1, (640, 512), (100, 80))})
    assert optics_accuracy.phase_error(Setup(part), samples=16)["phase_rms_px"] < 0.005


def test_seed_decides(rig):
    """The same seed gives the same bytes, another seed does not."""
    camera, projector = ideal_rig(rig, 0.125)
    light = Light.of(optics_accuracy.paper_surface(projector.camera.size), rig.projector)
    world = build_world(build_scene({"kind": "sphere"}))
    first, again, other = (render(world, CameraOptics.pinhole(camera), projector, light, Tracing(), seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
