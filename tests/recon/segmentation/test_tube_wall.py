"""How well is a tube measured by the echo of its wall? Images are sums of Gaussian echoes along the wall's front."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration
from recon.segmentation import tube_wall
from recon.segmentation.tube_wall import Ring

SCALE = np.array([0.12, 0.118])
SIZE = (320, 260)  # w, h
FINE = 3  # subpixels


def poses(count, rng, tilt_deg=4.0):
    """world_from_image of a sweep along a cylinder on the world's x axis, 14 mm below the face."""
    result = []
    for x in np.linspace(-20, 20, count):
        turn = Rotation.from_rotvec(np.deg2rad(rng.normal(0, tilt_deg, 3)))
        axes = turn.as_matrix() @ np.column_stack([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
        face = np.array([x, rng.normal(0, 1.0), -16 + rng.normal(0, 1.0)])
        result.append(rigid.transform(axes, face - axes[:, 0] * SCALE[0] * SIZE[0] / 2))
    return np.stack(result)


def wall(pose, radius, half_deg):
    """Front of the cylinder's section with the image plane : (n, 2) mm in the image."""
    across = pose[1:3, :2]
    middle = -np.linalg.solve(across, pose[1:3, 3])
    angle = np.deg2rad(np.linspace(-half_deg, half_deg, 4000))
    directions = np.column_stack([np.sin(angle), -np.cos(angle)])
    return middle + directions * (radius / np.linalg.norm(directions @ across.T, axis=1))[:, None]


def b_scan(pose, rng, radius, spread_mm=(0.2, 0.08), half_deg=88.0, noise=1e-3):
    """A log-compressed image, 60 dB, of diffuse echoes with `spread_mm` the sigma of their power; the top is over-exposed."""
    points = wall(pose, radius, half_deg) / SCALE
    field = np.zeros((2, FINE * SIZE[1], FINE * SIZE[0]))
    i = np.rint(FINE * (points + 0.5) - 0.5).astype(int)
    bright = 1 + 10 * np.exp(-(((points[:, 0] - points[:, 0].mean()) / 15) ** 2))
    for part in field:
        np.add.at(part, (i[:, 1], i[:, 0]), bright * rng.normal(size=len(points)))
    sigma = np.sqrt(2) * np.asarray(spread_mm)[::-1] / SCALE[::-1] * FINE
    field = np.stack([gaussian_filter(part, sigma) for part in field])[:, FINE // 2 :: FINE, FINE // 2 :: FINE]
    envelope = np.hypot(*field) / np.percentile(np.hypot(*field), 99.5)
    envelope = np.hypot(envelope, noise * np.abs(rng.normal(size=envelope.shape)))
    image = np.rint(np.clip(255 * (1 + 20 * np.log10(envelope + 1e-9) / 60), 0, 255)).astype(np.uint8)
    image[:8] = 255  # the face
    return image


def in_pixels(found):
    return found @ np.diag([*SCALE, 1, 1])


def test_diameter_and_axis_of_a_tube_in_a_freehand_sweep(rng):
    sweep = poses(9, rng)
    rings = [tube_wall.find(b_scan(pose, rng, 7.91), SCALE, tube_wall.Appearance(spread_mm=(0.2, 0.08))) for pose in sweep]
    assert all(one.found for one in rings)
    tube = tube_wall.fit_tube(rings, in_pixels(sweep))
    assert 2 * tube.shape.radius == pytest.approx(15.82, abs=0.05)
    assert np.linalg.norm(tube.shape.point[1:]) < 0.04
    assert np.rad2deg(np.arccos(abs(tube.shape.axis[0]))) < 0.15
    assert 0.0005 < tube.sigma_mm < 0.03


def test_the_bend_of_a_thin_tube_is_allowed_for():
    """Mean power without speckle: of a radius of 3 mm blurred by 0.4 mm, the ridge lies 0.4²/(2 3) = 0.027 mm too far in."""
    pose = rigid.transform([[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0, -SCALE[0] * 160, -12])
    power = np.zeros((FINE * SIZE[1], FINE * SIZE[0]))
    i = np.rint(FINE * (wall(pose, 3.0, 89.0) / SCALE + 0.5) - 0.5).astype(int)
    np.add.at(power, (i[:, 1], i[:, 0]), 1.0)
    power = gaussian_filter(power, 0.4 / SCALE[::-1] * FINE)[FINE // 2 :: FINE, FINE // 2 :: FINE]
    image = np.clip(255 * (1 + 10 * np.log10(power / power.max() + 1e-9) / 60), 0, 255)
    one = tube_wall.find(image, SCALE, tube_wall.Appearance(spread_mm=(0.4, 0.4)))
    offset = one.pixels * SCALE - [SCALE[0] * 160, 12.0]
    front = np.abs(np.arctan2(offset[:, 0], -offset[:, 1])) < np.deg2rad(40)
    assert front.sum() > 50
    assert np.linalg.norm(offset[front], axis=1).mean() == pytest.approx(3.0, abs=0.012)


def test_a_crest_that_outshines_the_sides_does_not_draw_them_out():
    """Power that falls by 1 neper a mm from the crest, blurred by 0.4 and 0.1 mm: at 45 degrees 0.5 (0.4² - 0.1²) = 0.075 mm."""
    pose = rigid.transform([[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0, -SCALE[0] * 160, -14])
    radius, spread = 8.0, (0.4, 0.1)
    points = wall(pose, radius, 89.0)
    angle = np.arctan2(points[:, 0] - SCALE[0] * 160, 14.0 - points[:, 1])
    power = np.zeros((FINE * SIZE[1], FINE * SIZE[0]))
    i = np.rint(FINE * (points / SCALE + 0.5) - 0.5).astype(int)
    np.add.at(power, (i[:, 1], i[:, 0]), np.exp(-radius * np.abs(angle)))
    power = gaussian_filter(power, np.array(spread)[::-1] / SCALE[::-1] * FINE)[FINE // 2 :: FINE, FINE // 2 :: FINE]
    image = np.clip(255 * (1 + 10 * np.log10(power / power.max() + 1e-9) / 60), 0, 255)
    one = tube_wall.find(image, SCALE, tube_wall.Appearance(spread_mm=spread))
    offset = one.pixels * SCALE - [SCALE[0] * 160, 14.0]
    side = np.abs(np.abs(np.arctan2(offset[:, 0], -offset[:, 1])) - np.deg2rad(40)) < np.deg2rad(15)
    assert side.sum() > 40
    assert np.linalg.norm(offset[side], axis=1).mean() == pytest.approx(radius, abs=0.02)


def test_a_wide_beam_is_stood(rng):
    sweep = poses(7, rng, tilt_deg=1.0)
    look = tube_wall.Appearance(spread_mm=(0.4, 0.1))
    rings = [tube_wall.find(b_scan(pose, rng, 5.0, spread_mm=look.spread_mm), SCALE, look) for pose in sweep]
    assert 2 * tube_wall.fit_tube(rings, in_pixels(sweep)).shape.radius == pytest.approx(10.0, abs=0.12)


def test_edges_scatter_as_much_as_they_say(rng):
    """Along the wall edges share their errors, so the spread is compared loosely: within a factor of 1.5."""
    pose = poses(1, rng, tilt_deg=0.0)[0]
    normalised = []
    for _ in range(5):
        one = tube_wall.find(b_scan(pose, rng, 7.91), SCALE)
        offset = rigid.apply(pose, np.column_stack([one.pixels * SCALE, np.zeros(len(one.pixels))]))[:, 1:]
        radial = np.linalg.norm(offset, axis=1)
        across = tube_wall._turned(one.covariance, in_pixels(pose[None])[0])[:, 1:, 1:]
        normal = offset / radial[:, None]
        normalised.append((radial - 7.91) / np.sqrt(np.einsum("ni,nij,nj->n", normal, across, normal)))
    spread = np.concatenate(normalised).std()
    assert 1 / 1.5 < spread < 1.5


def test_the_scores_are_gradients_of_the_robust_loss(rng):
    """A line with some points far off: numerical gradients of `scale² (sqrt(1 + z) - 1)`; in sum they vanish at the optimum."""
    x, scale, step = np.linspace(-1, 1, 40), 3.0, 1e-5
    y = 2 * x + 1 + rng.normal(size=40) + 12 * (rng.random(40) < 0.2)
    result = least_squares(lambda p: p[0] + p[1] * x - y, [0.0, 0.0], loss="soft_l1", f_scale=scale, gtol=1e-12, xtol=1e-12)

    def losses(p):
        return scale**2 * (np.sqrt(1 + ((p[0] + p[1] * x - y) / scale) ** 2) - 1)

    numerical = np.column_stack([(losses(result.x + d) - losses(result.x - d)) / (2 * step) for d in step * np.eye(2)])
    gradients = tube_wall._gradients(result.jac, result.fun, scale)
    assert np.abs(result.fun).max() > 2 * scale
    np.testing.assert_allclose(gradients, numerical, atol=1e-5)
    np.testing.assert_allclose(gradients.sum(axis=0), 0, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda image: np.zeros_like(image), "no echo stands out"),
        (lambda image: np.zeros((10, 10), np.uint8), "at least 32x32"),
        (lambda image: np.where(np.arange(SIZE[0])[None] < 165, image, 0).astype(np.uint8)[:, :], "arc|edges"),
    ],
)
def test_says_why_there_is_no_ring(change, reason, rng):
    image = b_scan(poses(1, rng, tilt_deg=0.0)[0], rng, 7.91, half_deg=60.0)
    assert tube_wall.find(image, SCALE).found
    found = tube_wall.find(change(image), SCALE)
    assert not found.found and len(found.pixels) == 0
    assert found.reason is not None and any(part in found.reason for part in reason.split("|"))


def test_a_flat_bottom_is_no_tube(rng):
    image = np.zeros(SIZE[::-1], np.uint8)
    image[150:158] = 255
    assert not tube_wall.find(image, SCALE).found
    slanted = np.zeros(SIZE[::-1], np.uint8)
    for u in range(SIZE[0]):
        slanted[100 + u // 4 : 108 + u // 4, u] = 255
    assert not tube_wall.find(slanted, SCALE).found


def test_images_without_a_pose_are_left_out_and_three_are_needed(rng):
    sweep = poses(5, rng)
    rings = [tube_wall.find(b_scan(pose, rng, 7.91), SCALE) for pose in sweep]
    matrices = in_pixels(sweep)
    matrices[1] = np.nan
    assert set(tube_wall.fit_tube(rings, matrices).frames) == {0, 2, 3, 4}
    with pytest.raises(InputError, match="at least three images"):
        tube_wall.fit_tube(rings[:2], matrices[:2])
    with pytest.raises(InputError, match="as many as poses"):
        tube_wall.fit_tube(rings, matrices[:4])


def test_an_uncertain_scale_is_an_uncertain_diameter():
    """Circles in the image: 1 % of sx and sy together are 1 % of the radius; of sx alone, near half of it."""
    scale, turned = np.array([0.2, 0.1]), np.radians(np.arange(0, 360, 2.0))
    pixels = (np.array([16.0, 15.0]) + 6.0 * np.column_stack([np.cos(turned), np.sin(turned)])) / scale
    one = Ring(pixels, np.tile(0.01 * np.eye(2), (len(pixels), 1, 1)))
    matrices = np.stack([rigid.transform(np.eye(3), [0, 0, k]) @ np.diag([*scale, 1, 1]) for k in range(8)])
    tube = tube_wall.fit_tube([one] * 8, matrices)

    def sigma(covariance: np.ndarray) -> float:
        known = Uncertainty(("sx", "sy"), covariance)
        return tube_wall.scale_sigma([one] * 8, matrices, tube, ProbeCalibration(np.eye(4), scale, known))

    together = np.outer(0.01 * scale, 0.01 * scale)
    assert sigma(together) == pytest.approx(0.06, rel=0.02)
    assert sigma(np.diag(np.diag(together))) == pytest.approx(0.06 / np.sqrt(2), rel=0.1)
    assert tube_wall.scale_sigma([one] * 8, matrices, tube, ProbeCalibration(np.eye(4), scale)) == 0
