"""Closed forms beside plain simulations: of a raster's light, of noise in fringes, points and poses."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from recon.geometry import rigid
from recon.geometry.primitives import Plane
from recon.model import circle_layout
from recon.model.patterns import Fringes
from recon.structured_light.phase import DEFAULT_NOISE, wrapped_phase
from scenes.kinds import plane
from twin.experiments import closed_forms
from twin.experiments.layout import Layout, laid_out
from twin.sensor import Exposure, read_out

PLACE = np.array([4.0, -2.0, 641.0])  # mm
FINE = 16  # samples a projector px
POSE = rigid.from_rotation_vector(np.deg2rad([170.0, 12.0, 8.0]), [60.0, 15.0, 640.0])  # of a target in both cameras' view


def shown(rig, fringes: Fringes, place: np.ndarray) -> np.ndarray:
    """Light that a pixel of camera 1 gathers : (steps, n) of fringes that mirrors of some width show, at n places along a row.

    Lenses' discs and point spreads and a camera's pixel one after another, each in projector px where the surface is.
    """
    value = fringes.profiles(1280)
    on = value if fringes.waveform == "binary" else value**rig.projector.gamma
    light = np.repeat((1 + (rig.projector.contrast - 1) * on) / rig.projector.contrast, FINE, axis=1)
    magnified = px_a_mm(rig.projector, place) / px_a_mm(rig.cam1, place)  # projector px for a camera px
    for device, size in ((rig.projector, 1.0), (rig.cam1, magnified)):
        light = gaussian_filter1d(light, device.lens.blur_px * size * FINE, axis=1)
        light = seen_through_a_disc(light, disc_px(device, place) * size * FINE)
    return uniform_filter1d(light, round(magnified * FINE), axis=1)


def seen_through_a_disc(light: np.ndarray, diameter: float) -> np.ndarray:
    """Light blurred along one axis by a disc's chords."""
    across = np.arange(-int(diameter), int(diameter) + 1)
    chords = np.sqrt(np.maximum((diameter / 2) ** 2 - across**2, 0)) + (across == 0) * 1e-9
    return np.stack([np.convolve(row, chords / chords.sum(), "same") for row in light])


def px_a_mm(device, place: np.ndarray) -> float:
    return device.optics.focal_px[0] / depth(device, place)


def disc_px(device, place: np.ndarray) -> float:
    """Diameter of the image of a point that is out of focus."""
    lens, z = device.lens, depth(device, place)
    return device.optics.focal_px[0] * lens.focal_length_mm / lens.f_number * abs(z - lens.focus_mm) / (z * lens.focus_mm)


def depth(device, place: np.ndarray) -> float:
    return rigid.apply(device.optics.device_from_world.matrix(), place)[2]


def inner(values: np.ndarray) -> np.ndarray:
    return values[..., 100 * FINE : -100 * FINE]


def wave(light: np.ndarray, fringes: Fringes) -> np.ndarray:
    return (light * np.exp(-1j * fringes.shifts[:, None])).sum(axis=0)


@pytest.mark.parametrize("waveform", ["sine", "binary"])
@pytest.mark.parametrize("pitch", [6, 12, 36])
@pytest.mark.parametrize("place", [PLACE, [4.0, -2.0, 600.0]], ids=["near focus", "out of focus"])
def test_contrast_is_that_of_a_blurred_raster(rig, pitch, waveform, place):
    """To 3 %: blur counts by its variance, whatever its shape; binary fringes light whole mirrors."""
    fringes = Fringes(pitch=pitch, steps=12, waveform=waveform, origin=639.5 if pitch % 4 == 0 else 639.0)
    light = inner(shown(rig, fringes, place))
    modulation = 2 / 12 * np.abs(wave(light, fringes))
    assert closed_forms.contrast(rig, fringes, place) == pytest.approx((modulation / light.mean(axis=0)).mean(), rel=0.03)


def test_gamma_and_black_change_the_contrast(rig):
    """A linear projector's is 1 before blur; one of gamma 2, `((1 + cos) / 2)^2`, has 4/3; black light takes its share."""

    def contrast(gamma: float, black: float) -> float:
        projector = rig.projector.model_copy(update={"gamma": gamma, "contrast": 1 / black})
        coarse = Fringes(pitch=1000, steps=3)
        return closed_forms.contrast(rig.model_copy(update={"projector": projector}), coarse, PLACE)

    assert contrast(1.0, 1e-9) == pytest.approx(1, abs=1e-4) and contrast(2.0, 1e-9) == pytest.approx(4 / 3, abs=1e-4)
    assert contrast(1.0, 0.25) == pytest.approx((3 / 8) / (1 / 4 + 3 / 8), abs=1e-4)


@pytest.mark.parametrize("pitch", [4, 6, 8, 12])
@pytest.mark.parametrize(("steps", "gamma"), [(5, 1.0), (8, 1.0), (8, 2.2)])
def test_mirrors_leave_the_error_of_their_raster(rig, pitch, steps, gamma):
    """RMS error of a phase without noise: no number of steps takes it out. To a tenth."""
    rig = rig.model_copy(update={"projector": rig.projector.model_copy(update={"gamma": gamma})})
    fringes = Fringes(pitch=pitch, steps=steps, first=1)
    assert closed_forms.raster_sigma(rig, fringes, PLACE) == pytest.approx(raster_error(rig, fringes), rel=0.1)


@pytest.mark.parametrize("pitch", [4, 12, 36])
def test_both_replicas_add_up_where_lenses_are_sharp(rig, pitch):
    """A projector of 0.3 px of blur, in focus: coarse fringes have two replicas nearly alike, whose squares come to 0.7 of it."""
    lens = rig.projector.lens.model_copy(update={"blur_px": 0.3, "focus_mm": depth(rig.projector, PLACE)})
    sharp = rig.model_copy(update={"projector": rig.projector.model_copy(update={"lens": lens})})
    fringes = Fringes(pitch=pitch, steps=8, first=1)
    assert closed_forms.raster_sigma(sharp, fringes, PLACE) == pytest.approx(raster_error(sharp, fringes), rel=0.05)


def raster_error(rig, fringes: Fringes) -> float:
    """RMS error of the phase, rad, of fringes that are simulated directly."""
    light = shown(rig, fringes, PLACE)
    x = (np.arange(light.shape[1]) + 0.5) / FINE - 0.5
    truth = np.exp(2j * np.pi * (x - fringes.zero(1280)) / fringes.pitch)
    return float(np.sqrt(np.mean(np.angle(inner(truth.conj() * wave(light, fringes))) ** 2)))


def test_blur_hides_the_raster(rig):
    """A projector out of focus, as the paper's for binary fringes, shows none."""
    lens = rig.projector.lens.model_copy(update={"focus_mm": 540.0})
    blurred = rig.model_copy(update={"projector": rig.projector.model_copy(update={"lens": lens})})
    fringes = Fringes(pitch=12, steps=8)
    assert closed_forms.raster_sigma(blurred, fringes, PLACE) < 0.1 * closed_forms.raster_sigma(rig, fringes, PLACE)


@pytest.mark.parametrize("steps", [3, 4, 8, 12])
def test_phase_noise_is_that_of_the_decoder(steps, rng):
    """Of 40 000 phases with noise of a twentieth of the modulation: their spread to 2 %, six of its own standard deviations."""
    phase, shifts = rng.uniform(-np.pi, np.pi, (200, 200)), 2 * np.pi * np.arange(steps) / steps
    images = 100 + 60 * np.cos(phase + shifts[:, None, None]) + 3 * rng.standard_normal((steps, 200, 200))
    found = wrapped_phase(images.astype(np.float32), shifts, noise=DEFAULT_NOISE, saturation=255.0).phase
    spread = np.angle(np.exp(1j * (found - phase))).std()
    assert closed_forms.phase_sigma(steps, 3.0, 60.0) == pytest.approx(spread, rel=0.02)


def test_a_pixels_noise_is_that_of_the_sensor(rig, rng):
    """Of 90 000 electrons drawn and rounded; darkness has what reading adds."""
    exposure, sensor = Exposure(0.01), rig.cam1.sensor
    gain = (255 - sensor.black_level_dn) / sensor.saturation_e  # the sensor's full charge fills the range; to half a DN
    for brightness in (0.0, 10.0, 120.0):
        mean = np.full((300, 300), brightness / gain, np.float32)
        numbers = np.rint(gain * read_out(mean, sensor.dark_noise_e, rng) + rng.random((300, 300)))  # at all fractions of a DN
        off = np.sqrt(numbers.var() - 1 / 12)  # of the fractions themselves
        assert closed_forms.brightness_noise(rig.cam1, brightness, exposure) == pytest.approx(off, rel=0.02)


SHAPES = [plane.build(plane.PAPER_POSES[k]).shapes[0] for k in (0, 4)]
TILTED = Plane("tilted", np.array([0.0, 0.0, 660.0]), np.array([0.2, 0.8, -0.8]) / np.linalg.norm([0.2, 0.8, 0.8]))


@pytest.mark.parametrize("shape", [*SHAPES, TILTED], ids=["first", "last", "tilted"])
def test_points_of_a_plane_are_off_by_the_columns_noise(rig, shape, rng):
    """A projector's column is off by a twentieth of a pixel: rays of camera 1 meet the wrong sheet of light, by bisection."""
    camera, projector = rig.cam1.optics.camera(), rig.projector.optics.camera()
    pixels = rng.uniform(0, np.array(camera.size) - 1, (4000, 2))
    rays = camera.rays(pixels)
    distance = (shape.point - camera.centre) @ shape.normal / (rays @ shape.normal)
    columns = projector.project(camera.centre + rays * distance[:, None])
    seen = ((columns > -0.5) & (columns < np.array(projector.size) - 0.5)).all(axis=1)
    rays, distance = rays[seen], distance[seen]
    found = columns[seen, 0] + 0.05 * rng.standard_normal(seen.sum())
    near, far = distance - 5, distance + 5
    rises = (
        projector.project(camera.centre + rays * far[:, None])[:, 0]
        > projector.project(camera.centre + rays * near[:, None])[:, 0]
    )
    for _ in range(40):
        middle = (near + far) / 2
        beyond = (projector.project(camera.centre + rays * middle[:, None])[:, 0] > found) == rises
        near, far = np.where(beyond, near, middle), np.where(beyond, middle, far)
    off = (camera.centre + rays * near[:, None] - shape.point) @ shape.normal
    assert seen.mean() > 0.5
    assert closed_forms.plane_sigma(rig, shape, 0.05) == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.05)


@pytest.mark.parametrize("tolerance_mm", [0.0, 0.1])
def test_no_pose_is_better_than_its_bound_and_least_squares_reach_it(rig, tolerance_mm, rng):
    """Of 400 noisy views of targets printed to a tolerance: the covariance of poses, to 9 %.

    A plain least-squares fit of pose and lengths, where the tolerance holds the lengths: Gauss and Newton, all views at once.
    """
    target = rig.target.model_copy(update={"tolerance_mm": tolerance_mm})
    cameras = rig.cam1.optics.camera(), rig.cam2.optics.camera()
    sigma = np.array([[0.05, 0.1, 0.05], [0.1, 0.05, 0.2]])
    lengths, spread = circle_layout.lengths(target), circle_layout.length_covariance(target) + 1e-8 * np.eye(3)
    weight = np.linalg.inv(np.linalg.cholesky(spread))
    off = rng.multivariate_normal(np.zeros(3), spread, 400)

    def residuals(change, seen):
        """Of changes : (n, 9) of pose and lengths, in standard deviations : (n, 15)."""
        views = (centres(cameras, change[:, :6], lengths + change[:, 6:], target) - seen) / sigma[:, None, :, None]
        return np.concatenate([np.swapaxes(views, 0, 1).reshape(len(change), -1), change[:, 6:] @ weight.T], axis=1)

    exact = centres(cameras, np.zeros((400, 6)), lengths + off, target)
    seen = exact + sigma[:, None, :, None] * rng.standard_normal(exact.shape)
    found = np.zeros((400, 9))
    for _ in range(6):
        off_by = residuals(found, seen)
        slope = np.stack([(residuals(found + step, seen) - off_by) / step.sum() for step in 1e-3 * np.diag(SCALE)], axis=-1)
        found = (
            found - np.linalg.solve(np.swapaxes(slope, 1, 2) @ slope, np.einsum("nri,nr->ni", slope, off_by)[..., None])[..., 0]
        )
    left = np.einsum("nri,nr->ni", slope, residuals(found, seen))
    assert np.abs(left * np.sqrt(np.diag(np.linalg.inv(slope[0].T @ slope[0])))).max() < 1e-3  # it is the least
    bound = closed_forms.pose_covariance(cameras, POSE, target, sigma)
    whitened = np.linalg.solve(np.linalg.cholesky(bound), found[:, :6].T)
    assert np.linalg.eigvalsh(np.cov(whitened)) == pytest.approx(1, abs=0.35)
    assert np.mean(whitened**2) == pytest.approx(1, abs=0.09)


SCALE = np.array([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.1, 0.1, 0.1, 0.1])


def centres(cameras, changes, lengths, target) -> np.ndarray:
    """Pixels : (2, n, 3, 2) of circles in both cameras, of n changes of the pose and n sets of lengths."""
    poses = rigid.moved(np.broadcast_to(POSE, (len(changes), 4, 4)), changes)
    on_target = np.moveaxis(circle_layout.by_length(target) @ lengths.T, -1, 0)
    points = on_target @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    return np.stack([camera.project(points) for camera in cameras])


def test_a_larger_target_is_seen_to_turn_better(rig):
    """Twice as large, half the turn; of the shift, what its turns leave."""
    cameras = rig.cam1.optics.camera(), rig.cam2.optics.camera()
    small = rig.target.model_copy(update={"tolerance_mm": 0.0})
    large = small.model_copy(update={"c1_mm": 2 * small.c1_mm, "c2_mm": 2 * small.c2_mm})
    turns = [
        np.sqrt(np.diag(closed_forms.pose_covariance(cameras, POSE, target, np.full((2, 3), 0.1)))[:3])
        for target in (small, large)
    ]
    assert turns[0] / turns[1] == pytest.approx(2, rel=0.1)


def test_the_finest_fringes_along_the_columns_measure(settings):
    parts = (Fringes(pitch=8, axis="rows", steps=4), Fringes(pitch=18, steps=4), Fringes(pitch=64, steps=8))
    patterns = settings.patterns.model_copy(update={"parts": parts})
    assert closed_forms.fringes_of(patterns) == parts[1]


def test_farther_projectors_measure_depth_better(rig):
    """Distances from 60 to 300 mm: the error falls all the way, nearly as their inverse."""
    (shape,) = plane.build(plane.PAPER_POSES[2]).shapes
    distances = [60.0, 120.0, 240.0]
    errors = [closed_forms.plane_sigma(laid_out(rig, Layout(projector_mm=each)), shape, 0.05) for each in distances]
    assert all(1.7 < near / far < 2.1 for near, far in pairwise(errors))
