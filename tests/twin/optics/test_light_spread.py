"""Light that spreads beneath skin: against the profile it is named for, and against quadrature over a surface."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.integrate import quad
from scipy.special import j0

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.patterns import CentreLine, Fringes, Patterns
from scenes.scene_types import Material, Scene, Thing
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_spread import REACH, blurred, modulation_transfer
from twin.optics.light_transport import Tracing, render
from twin.optics.raster import OVERSAMPLING, Light
from twin.optics.ray_world import build_world, translucent

CAMERA = Camera((32, 32), np.array([[800.0, 0, 15.5], [0, 800, 15.5], [0, 0, 1]]), np.zeros(0))
ASIDE = rigid.from_rotation_vector([0, np.deg2rad(14), 0], [0, 0, 0]) @ rigid.transform(np.eye(3), [-150, 0, 0])
PROJECTOR = Camera((512, 512), np.array([[1600.0, 0, 255.5], [0, 1600, 255.5], [0, 0, 1]]), np.zeros(0), ASIDE)
MIDDLE = np.array([0.0, 0.0, 600.0])
PATTERNS = Patterns(
    projector_size=(512, 512),
    unwrap="centre_line",
    parts=(CentreLine(), Fringes(pitch=12, steps=4), Fringes(axis="rows", pitch=18, steps=4), CentreLine(axis="rows")),
)
LIGHT = Light(
    (512, 512), tuple(axis for axis, _, _ in PATTERNS.profiles()), tuple(np.float32(one) for *_, one in PATTERNS.profiles()), 0.6
)


def density(r: float) -> float:
    """Christensen & Burley's, of length 1."""
    return (np.exp(-r) + np.exp(-r / 3)) / (8 * np.pi * r)


def plate(spread_mm: float, material: Material | None = None, tilt_deg: float = 0.0) -> Scene:
    mesh = trimesh.creation.box((400, 400, 2))
    mesh.apply_translation((0, 0, 1))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.deg2rad(tilt_deg), (0.3, 1, 0)))
    mesh.apply_translation(MIDDLE)
    return Scene("plate", (Thing("plate", mesh, replace(material or Material(0.6), spread_mm=spread_mm), smooth=False),))


def shown(scene: Scene) -> np.ndarray:
    world, projector = build_world(scene), ProjectorOptics(PROJECTOR, 0.0, 1.0, 0.0, 1.0)
    images = render(world, CameraOptics.pinhole(CAMERA), projector, LIGHT, Tracing(samples=16), 3, translucent(scene, world))
    assert (images[1:].sum(axis=0) > 0).all()
    return images.astype(float)


def phasors(images: np.ndarray) -> np.ndarray:
    """Relative modulation and phase of both axes' fringes : (2, h, w) complex."""
    sets = images[1:5], images[5:9]
    return np.array([((i[0] - i[2]) + 1j * (i[3] - i[1])) / i.sum(axis=0) * 2 for i in sets])


@pytest.mark.parametrize("cycles", [0.03, 0.1, 0.4])
def test_transfer_is_that_of_the_profile(cycles):
    """The modulation of a wave is the Hankel transform of the profile, here as a sum over rings."""
    expected = quad(lambda r: 2 * np.pi * r * density(r) * j0(2 * np.pi * cycles * r), 0, 40, limit=400)[0]
    assert modulation_transfer(np.array(cycles)) == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize("length", [0.3, 2.0])
def test_a_line_keeps_its_light(length):
    """One lit mirror comes out with its light, and with a variance of 7 d^2, the second moment of the profile, more."""
    fine = np.zeros((1, 160 * OVERSAMPLING), np.float32)
    fine[0, 80 * OVERSAMPLING : 81 * OVERSAMPLING] = 1
    place = np.arange(fine.shape[1]) / OVERSAMPLING
    after = blurred(fine, length)[0].astype(float)
    middle = (after * place).sum() / after.sum()
    second, _ = quad(lambda r: 2 * np.pi * r * density(r) * r * r / 2, 0, 200, limit=400)
    assert second == pytest.approx(7, rel=1e-3)
    assert after.sum() == pytest.approx(OVERSAMPLING, rel=2e-3)
    assert (after * (place - middle) ** 2).sum() / after.sum() == pytest.approx(1 / 12 + 7 * length**2, rel=0.02)


@pytest.mark.parametrize("tilt_deg", [0.0, 50.0])
def test_plate_shows_the_pattern_gathered_around_each_point(tilt_deg):
    """At the image's middle: the fringes' modulation and phase by quadrature over the plate, through the true projection."""
    length = 0.8
    before, after = (
        phasors(shown(plate(spread, tilt_deg=tilt_deg)))[:, 15:17, 15:17].mean(axis=(1, 2)) for spread in (0.0, length)
    )
    radii = np.geomspace(1e-4, REACH, 600) * length
    weights = np.gradient(np.log(radii)) * radii * density(radii / length) * radii / length**2
    turns = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    ring = np.stack([np.outer(radii, np.cos(turns)), np.outer(radii, np.sin(turns)), np.zeros((600, 180))], axis=-1)
    pose = trimesh.transformations.rotation_matrix(np.deg2rad(tilt_deg), (0.3, 1, 0))
    pixels = PROJECTOR.project(rigid.apply(pose, ring.reshape(-1, 3)) + MIDDLE).reshape(600, 180, 2)
    at_once = PROJECTOR.project(MIDDLE[None])[0]
    for axis, pitch in enumerate((12, 18)):
        wave = np.exp(2j * np.pi * (pixels[..., axis] - at_once[axis]) / pitch).mean(axis=1)
        expected = 2 * np.pi * (weights * wave).sum() / (2 * np.pi * weights.sum())
        found = after[axis] / before[axis]
        assert abs(found) == pytest.approx(abs(expected), abs=0.006)
        assert abs(np.angle(found)) < 0.004  # rad, of 0.0025 that perspective makes
        assert abs(expected) < 0.75  # so that it says something


def test_gloss_does_not_spread():
    """A coat on black shows the fringes as sharp as ever."""
    black = Material(0.0, roughness=0.4)
    np.testing.assert_array_equal(shown(plate(0.8, black)), shown(plate(0.0, black)))


def test_even_light_stays():
    """All of a fringe set together is even light, of which the spread takes nothing."""
    before, after = (shown(plate(spread, Material(0.5, 0.3)))[1:5].sum(axis=0) for spread in (0.0, 0.8))
    np.testing.assert_allclose(after, before, rtol=2e-3)
