"""Projector coordinates of a board's points: unbiased, as noisy as predicted, deaf to outliers, none where nothing is seen."""

import cv2
import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.optical_calibration.projector_points import correspondences
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.phase import Noise

SPACING, RADIUS = 14.0, 4.5  # mm, of a grid of black discs: 45 px in diameter
WHITE, BLACK = 0.75, 0.05  # reflectances
SIGMA = 0.025  # projector px, of white: 18 steps of 18 px
ALONG = np.arange(-3, 4) * SPACING
GRID = np.stack(np.meshgrid(ALONG, ALONG[1:-1]), axis=-1).reshape(-1, 2)  # (35, 2) mm, on the board
WINDOW = (slice(200, 840), slice(260, 1000))  # rows, columns of camera 1 that the tests look at


def board(rig, tilt_deg, blur=1.0, points=GRID, albedo=None):
    """A tilted board before the rig: map : (h, w, 2), albedo as seen : (h, w), centres, their truth, px, and the true gradient.

    The map is what each pixel sees of the projector through a Gaussian point spread of `blur` px: its mean over the albedo.
    """
    cam1, projector = rig.cam1.optics.camera(), rig.projector.optics.camera()
    axis = np.array([0.5, 0.85, 0.1])
    world_from_board = rigid.from_rotation_vector(np.deg2rad(tilt_deg) * axis / np.linalg.norm(axis), (0.0, 0.0, 660.0))

    def seen(pixels):
        rays = cam1.rays(pixels)
        normal, origin = world_from_board[:3, 2], world_from_board[:3, 3]
        return rays * (normal @ origin / (rays @ normal))[..., None]

    corner = np.array([WINDOW[1].start, WINDOW[0].start])
    surface = seen(cam1.pixel_grid()[WINDOW])
    exact = projector.project(surface)
    on_board = rigid.apply(rigid.invert(world_from_board), surface)[..., :2]
    if albedo is None:
        off = on_board[..., None, :] - points
        albedo = np.where((np.square(off).sum(axis=-1) < RADIUS**2).any(axis=-1), BLACK, WHITE)
    else:
        albedo = albedo(on_board)
    spread, image = albedo[..., None] * exact, albedo
    if blur:
        spread, image = cv2.GaussianBlur(spread, (0, 0), blur), cv2.GaussianBlur(image, (0, 0), blur)
    centres = cam1.project(rigid.apply(world_from_board, np.column_stack([points, np.zeros(len(points))])))
    step = 0.5 * np.eye(2)
    truth = projector.project(seen(centres))
    gradient = np.stack([projector.project(seen(centres + s)) - projector.project(seen(centres - s)) for s in step], axis=-1)
    return spread / image[..., None], image, centres - corner, truth, gradient


def projector_map(x, image, rng=None, factor=1.0):
    """A decoded map : (h, w, 2) with the noise of this much light, `factor` times as large as it says."""
    sigma = SIGMA * np.sqrt(0.3 + 0.7 * image / WHITE) * WHITE / image
    noisy = x if rng is None else x + factor * sigma[..., None] * rng.normal(size=x.shape)
    columns, rows, sigma = (np.ascontiguousarray(m, np.float32) for m in (noisy[..., 0], noisy[..., 1], sigma))
    status = np.zeros(image.shape, np.uint8)
    return ProjectorMap(columns, rows, sigma, sigma.copy(), sigma, sigma, sigma, status, status == 0, Noise(1, 0), {})


@pytest.fixture(scope="module")
def tilted(rig):
    return board(rig, 25.0)


def photograph(image, rng):
    return np.clip(np.rint(8 + 280 * image + rng.normal(size=image.shape) * np.sqrt(0.5 + 9 * image)), 0, 255).astype(np.uint8)


def test_a_parabola_is_enough(rig):
    """Without noise and blur, what is left out of the map over a window is far below its noise."""
    x, image, centres, truth, gradient = board(rig, 40.0, blur=0)
    found = correspondences(projector_map(x, image), np.full(image.shape, 200.0), centres, 38.0)
    assert np.abs(found.pixels - truth).max() < 2e-4  # float32 maps of 1000 px are exact to 3e-5
    assert found.gradient == pytest.approx(gradient, abs=2e-4)


def test_predicted_covariance_is_the_noise(tilted, rng):
    """Errors over predicted sigmas are standard normal; blurred edges of the discs included."""
    x, image, centres, truth, _ = tilted
    z = []
    for _ in range(10):
        found = correspondences(projector_map(x, image, rng), photograph(image, rng), centres, 38.0)
        z.append((found.pixels - truth) / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)))
    z = np.array(z)
    assert np.isfinite(z).all()
    assert abs(z.std() - 1) < 0.08  # 700 values: 2.7 % standard error
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert np.sqrt(found.covariance[:, 0, 0]).max() < 0.003
    assert (found.covariance[:, 0, 1] == 0).all()


@pytest.mark.parametrize("blur", [0.6, 3.0])
def test_edges_do_not_bias(rig, rng, blur):
    """Pixels beside the discs' borders see the brighter side. Left in, they falsify the gradient, though hardly the value."""
    x, image, centres, truth, gradient = board(rig, 25.0, blur)
    found = projector_map(x, image)
    lit = photograph(image, rng)
    left_out = correspondences(found, lit, centres, 38.0)
    assert np.abs(left_out.pixels - truth).max() < (0.006 if blur > 2 else 0.001)  # little is left beside wide edges
    assert np.abs(left_out.gradient - gradient).max() < 5e-4
    kept = correspondences(found, np.full_like(lit, 200), centres, 38.0)  # as if the board were white
    assert np.abs(kept.gradient - gradient).max() > 3 * np.abs(left_out.gradient - gradient).max()


def test_chessboard_corners(rig, rng):
    x, image, centres, truth, _ = board(
        rig, 25.0, albedo=lambda p: np.where((np.floor(p / SPACING).astype(int).sum(axis=-1)) % 2, BLACK, WHITE)
    )
    found = correspondences(projector_map(x, image, rng), photograph(image, rng), centres, 30.0)
    z = (found.pixels - truth) / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert np.abs(z).max() < 4.5
    assert abs(z.mean()) < 5 / np.sqrt(z.size)


def test_outliers_are_harmless(tilted, rng):
    """2 % of the pixels off by a period, and dust of 6 px beside each disc: no worse than the noise."""
    x, image, centres, truth, _ = tilted
    clean = correspondences(projector_map(x, image, rng), photograph(image, rng), centres, 38.0)
    x = x + 18.0 * rng.choice([-1, 0, 1], p=[0.01, 0.98, 0.01], size=x.shape)
    for u, v in np.rint(centres + np.array([27, 10])).astype(int):
        x[v - 3 : v + 3, u - 3 : u + 3] += 3.0
    found = correspondences(projector_map(x, image, rng), photograph(image, rng), centres, 38.0)
    z = (found.pixels - truth) / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert np.abs(z).max() < 4.5
    assert found.covariance[:, 0, 0] == pytest.approx(clean.covariance[:, 0, 0], rel=0.2)


@pytest.mark.parametrize("kind", ["larger", "correlated"])
def test_errors_beyond_the_prediction_show(tilted, rng, kind):
    """Noise twice as large as predicted, or correlated between neighbours, gives errors that the covariance still covers."""
    x, image, centres, truth, _ = tilted
    z = []
    for _ in range(4):
        if kind == "larger":
            found = projector_map(x, image, rng, 2.0)
        else:
            rough = cv2.GaussianBlur(rng.normal(size=x.shape), (0, 0), 2.0)
            found = projector_map(x + SIGMA * rough / rough.std(), image, rng)
        result = correspondences(found, photograph(image, rng), centres, 38.0)
        z.append((result.pixels - truth) / np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2)))
    assert 0.8 < np.std(z) < 1.25  # blocks of 11 px hold most of a correlation over 3 px


def test_border_of_the_view_gives_nothing(tilted, rng):
    """Where the fringes end within the window's disc the parabola would have to be continued."""
    x, image, centres, truth, _ = tilted
    ends = 330.0  # px, below it nothing is lit
    x = x.copy()
    x[: int(ends)] = np.nan
    found = correspondences(projector_map(x, image, rng), photograph(image, rng), centres, 38.0)
    height = centres[:, 1] - ends
    near, far = height < 22, height > 38
    assert near.sum() > 3 and far.sum() > 3
    assert np.isnan(found.pixels[near]).all() and np.isnan(found.covariance[near]).all() and np.isnan(found.gradient[near]).all()
    assert np.isfinite(found.pixels[far]).all()
    seen = np.isfinite(found.pixels).all(axis=1)
    error = found.pixels - truth
    assert np.abs(error[seen] / np.sqrt(np.diagonal(found.covariance[seen], axis1=1, axis2=2))).max() < 4.5
    outside = np.array([[-50.0, 10.0], [5000.0, 5000.0], [np.nan, 3.0], [0.0, 0.0]])
    assert np.isnan(correspondences(projector_map(x, image), photograph(image, rng), outside, 38.0).pixels).all()


def test_both_axes_are_needed(tilted):
    x, image, centres, _, _ = tilted
    found = projector_map(x, image)
    half = ProjectorMap(
        found.columns, None, found.sigma_columns, None, *(found.modulation,) * 3, found.status, found.lit, found.noise, {}
    )
    with pytest.raises(InputError, match="both axes, found none of rows"):
        correspondences(half, image, centres, 38.0)
    with pytest.raises(InputError, match="lit image: expected 740x640 grey"):
        correspondences(found, image[:-1], centres, 38.0)
