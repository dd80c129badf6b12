"""The camera model against OpenCV's, and against itself backwards."""

import warnings

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.geometry import rigid
from recon.geometry.camera import FEW, FEW_PROJECTED, Camera, distorted

MATRIX = np.array([[3320.0, 0, 618], [0, 3331, 523], [0, 0, 1]])
WIDE = np.array([[1250.0, 0, 650], [0, 1240, 500], [0, 0, 1]])

# realistic lenses first, then strong ones; all stay invertible over the image
LENSES = {
    "none": (MATRIX, []),
    "four": (MATRIX, [-0.11, 0.25, 0.0004, -0.0006]),
    "five": (MATRIX, [-0.11, 0.25, 0.0004, -0.0006, 0.3]),
    "rational": (WIDE, [0.9, -0.3, 0.001, -0.002, 0.05, 1.2, -0.2, 0.04]),
    "thin prism": (WIDE, [-0.2, 0.1, 0.001, -0.001, 0.02, 0.01, 0.02, 0.0, 0.004, -0.003, 0.005, 0.002]),
    "tilted": (WIDE, [-0.25, 0.12, 0.002, -0.001, -0.03, 0.02, -0.01, 0.005, 0.003, -0.002, 0.002, 0.001, 0.06, -0.09]),
    "barrel": (WIDE, [-0.32, 0.14, 0, 0, -0.03]),
    "pincushion": (WIDE, [0.35, 0.2, 0.004, -0.003, 0.1]),
}


@pytest.fixture(params=LENSES, ids=str)
def camera(request) -> Camera:
    matrix, distortion = LENSES[request.param]
    pose = rigid.from_rotation_vector([0.1, -0.25, 0.05], [-150.0, 20.0, 30.0])
    return Camera((1280, 1024), matrix, np.array(distortion), pose)


def test_every_pixel_returns_to_itself(camera):
    """Along its ray and back through the lens, everywhere in the image, to 1e-6 px: the solver's tolerance times f."""
    pixels = camera.pixel_grid()[::3, ::3]
    points = camera.centre + 660 * camera.rays(pixels)
    assert np.abs(camera.project(points) - pixels).max() < 1e-6


def test_projection_is_opencvs(camera):
    """Same model as cv2.projectPoints, to rounding."""
    points = camera.centre + 660 * camera.rays(camera.pixel_grid()[::16, ::16].reshape(-1, 2))
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    distortion = camera.distortion if camera.distortion.size else None
    expected, _ = cv2.projectPoints(points.reshape(-1, 1, 3), cv2.Rodrigues(rotation)[0], translation, camera.matrix, distortion)
    assert np.abs(camera.project(points) - expected.reshape(-1, 2)).max() < 1e-8


def test_undistortion_is_opencvs(camera):
    """OpenCV's iterative inverse, run long enough to converge, finds the same ideal points: 1e-3 px as normalised coordinates."""
    pixels = camera.pixel_grid()[::16, ::16].reshape(-1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    distortion = camera.distortion if camera.distortion.size else np.zeros(4)
    iterate = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # OpenCV 4, 5
    expected = iterate(pixels.reshape(-1, 1, 2), camera.matrix, distortion, R=None, P=None, criteria=criteria)
    assert np.abs(camera.undistort(pixels) - expected.reshape(-1, 2)).max() < 1e-3 / camera.matrix[0, 0]


def test_points_behind_give_nan(camera):
    in_front = camera.centre + 100 * camera.rays(np.array([640.0, 512.0]))
    behind = camera.centre - 100 * camera.rays(np.array([640.0, 512.0]))
    assert np.isfinite(camera.project(in_front)).all() and np.isnan(camera.project(behind)).all()


def test_a_few_rays_are_those_of_all(camera):
    """A few pixels are undistorted on one core, many on all: to the same bits. A pixel that is none has no ray."""
    pixels = camera.pixel_grid()[::100, ::100].reshape(-1, 2)
    assert len(pixels) > FEW
    assert np.array_equal(camera.rays(pixels), np.concatenate([camera.rays(few) for few in np.array_split(pixels, 50)]))
    assert np.isnan(camera.rays(np.full((1, 2), np.nan))).all()


def test_rays_of_all_pixels_are_those_of_each(camera):
    """Begun at their neighbours', to rounding."""
    assert np.abs(camera.pixel_rays() - camera.rays(camera.pixel_grid())).max() < 1e-12


def test_a_few_points_are_projected_as_all_are(camera):
    """Array by array and in threads, to rounding; and, in silence, points whose pixels no number holds."""
    rays = camera.rays(camera.pixel_grid()[::20, ::20].reshape(-1, 2))
    points = camera.centre + 660 * rays
    assert len(points) > FEW_PROJECTED
    found = np.concatenate([camera.project(part) for part in np.array_split(points, 7)])
    assert np.abs(found - camera.project(points)).max() < 1e-9
    ahead = Camera(camera.size, camera.matrix, camera.distortion)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not np.isfinite(ahead.project([[1.0, 1.0, 1e-200], [0.0, 0.0, -1.0]])).any()


def test_unreachable_pixels_give_nan():
    """Past the radius where a barrel polynomial turns back, no ray reaches a pixel."""
    camera = Camera((320, 256), np.array([[125.0, 0, 160], [0, 125, 128], [0, 0, 1]]), np.array([-0.4, 0, 0, 0, 0]))
    normalised = camera.undistort(np.array([[160.0, 128.0], [0.0, 0.0]]))
    assert np.isfinite(normalised[0]).all() and np.isnan(normalised[1]).all()
    rays, each = camera.pixel_rays(), camera.rays(camera.pixel_grid())
    assert np.array_equal(np.isnan(rays), np.isnan(each)) and np.nanmax(np.abs(rays - each)) < 1e-9


@pytest.mark.parametrize(
    ("distortion", "turn"),
    [
        ([-0.4, 0, 0, 0], np.sqrt(1 / 1.2)),  # r (1 - 0.4 r^2)
        ([-0.5, 0.1, 0, 0], 1.0),  # r (1 - r^2 / 2 + r^4 / 10) turns back at 1 and outwards again at sqrt 2
    ],
)
def test_a_lens_ends_where_its_radius_turns(distortion, turn, rng):
    """Few points or many, up to there each comes back along its ray; past it no pixel has a ray and no ray a pixel."""
    camera = Camera((1280, 1024), WIDE, np.array(distortion))
    angles, shares = rng.uniform(0, 2 * np.pi, 2 * FEW_PROJECTED), rng.uniform(0.01, 3, 2 * FEW_PROJECTED)
    shares = shares[np.abs(shares - 1) > 1e-3]
    ways = np.column_stack([np.cos(angles), np.sin(angles)])[: len(shares)]
    points = np.column_stack([turn * shares[:, None] * ways, np.ones(len(shares))])
    inside = shares < 1
    for part in (slice(None), slice(50)):
        pixels = camera.project(points[part])
        assert np.array_equal(np.isfinite(pixels).all(axis=-1), inside[part]) and np.isnan(pixels[~inside[part]]).all()
        assert np.abs(camera.undistort(pixels) - points[part, :2])[inside[part]].max() < 1e-6
    beyond = camera.to_pixels(np.stack(distorted(*points[~inside, :2].T, camera.coefficients), axis=-1))
    found = camera.undistort(beyond)
    assert (np.linalg.norm(found[np.isfinite(found).all(axis=1)], axis=1) <= turn).all()


def test_no_ray_is_found_on_the_outer_branch_of_a_lens():
    """r (1 - r^2 / 2 + r^4 / 10) reaches 0.6 at 1, and 0.8 once more at 1.82."""
    camera = Camera((1280, 1024), WIDE, np.array([-0.5, 0.1, 0, 0]))
    pixels = camera.to_pixels(np.column_stack([[0.55, 0.62, 0.7, 0.8], np.zeros(4)]))
    assert np.isnan(camera.undistort(pixels)).all(axis=1).tolist() == [False, True, True, True]


def test_decentring_ends_a_lens_where_it_turns_last():
    """The image's corner that a lens without decentring would have turned before: it is sound there, so it has its pixel."""
    turn = np.sqrt(1 / 1.2)
    camera = Camera((1280, 1024), WIDE, np.array([-0.4, 0, 0, 0.004]))
    assert np.isfinite(camera.project([[1.004 * turn, 0, 1], [-0.98 * turn, 0, 1]])).all()
    assert np.isnan(camera.project([[1.02 * turn, 0, 1], [-1.02 * turn, 0, 1]])).all()


def test_a_camera_keeps_its_values():
    """Whatever becomes of the arrays that it was made of, and not by an assignment that its cached layout would miss."""
    matrix, distortion, pose = WIDE.copy(), np.array([-0.1, 0, 0, 0]), np.eye(4)
    camera = Camera((1280, 1024), matrix, distortion, pose)
    before = camera.project([[0.5, 0.2, 1.0]])
    for array in (matrix, distortion, pose):
        array *= 3
    assert np.array_equal(camera.project([[0.5, 0.2, 1.0]]), before)
    for kept in (camera.matrix, camera.distortion, camera.camera_from_world, camera.coefficients):
        with pytest.raises(ValueError, match="read-only"):
            kept[0] = 1
    assert camera != Camera((1280, 1024), WIDE, distortion)  # by identity, as arrays have no truth value


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"matrix": np.eye(2)}, "matrix"),
        ({"matrix": np.diag([-1.0, 1, 1])}, "matrix"),
        ({"matrix": MATRIX.T}, "matrix"),
        ({"matrix": MATRIX * 2}, "matrix"),
        ({"matrix": MATRIX + np.array([[0, 0, 0], [0.1, 0, 0], [0, 0, 0]])}, "matrix"),
        ({"distortion": np.zeros(6)}, "distortion"),
        ({"distortion": np.array([np.nan, 0, 0, 0])}, "distortion"),
        ({"camera_from_world": np.full((4, 4), np.nan)}, "camera_from_world"),
        ({"camera_from_world": np.diag([1.0, 1, -1, 1])}, "camera_from_world"),
        ({"camera_from_world": rigid.from_rotation_vector([0.1, 0, 0], [1.0, 2, 3]).T}, "camera_from_world"),
    ],
)
def test_nonsense_is_refused_by_name(change, field):
    good = {"size": (1280, 1024), "matrix": MATRIX, "distortion": np.zeros(5)}
    with pytest.raises(ValueError, match=f"^{field}: expected"):
        Camera(**(good | change))


@given(st.tuples(*[st.floats(-3, 3)] * 3))
def test_a_rotation_may_have_six_decimals(turn):
    """Half a unit of the sixth decimal in each entry changes a product of two rows by less than 1.8e-6."""
    Camera((64, 48), MATRIX, np.zeros(5), np.round(rigid.from_rotation_vector(turn, [0, 0, 0]), 6))


@pytest.mark.parametrize(("row", "column"), [(0, 1), (0, 0), (3, 0)])
def test_a_pose_has_all_its_digits(row, column):
    """5e-6 rad are 0.02 px of our cameras; an error of the last row it would pass unseen into all products."""
    pose = np.eye(4)
    pose[row, column] += 5e-6
    with pytest.raises(ValueError, match=r"^camera_from_world: expected a rigid transform .* 5e-06|1\.000005"):
        Camera((64, 48), MATRIX, np.zeros(5), pose)
