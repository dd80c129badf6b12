import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from recon.board_detection import lattice, reduced_images
from recon.board_detection.detect import BoardNotFound, detect
from recon.board_detection.kinds import aprilgrid, chessboard
from recon.board_detection.kinds.aprilgrid import AprilGrid
from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_detection.kinds.charuco import Charuco
from recon.board_detection.kinds.chessboard import Chessboard
from recon.board_detection.kinds.symmetric_circles import SymmetricCircles
from recon.board_detection.lattice import assign
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_projection import centre_offsets
from recon.model.boards import Discs
from tests.recon import board_views
from tests.recon.board_views import pose, view

CAMERA = Camera((480, 400), np.array([[1300, 0, 240], [0, 1305, 198], [0, 0, 1.0]]), np.array([-0.2, 0.3, 0.001, -0.001, 0]))
ASYMMETRIC = AsymmetricCircles(columns=4, rows=7, spacing_mm=15, diameter_mm=10)
SYMMETRIC = SymmetricCircles(columns=5, rows=4, spacing_mm=22, diameter_mm=12)
CHESSBOARD = Chessboard(columns=6, rows=5, square_mm=18)
CHARUCO = Charuco(columns=5, rows=4, square_mm=26, marker_mm=18)
APRILGRID = AprilGrid(columns=3, rows=2, tag_mm=28)
TILTED = (0.35, -0.3)


@pytest.fixture(scope="module")
def clean():
    """Views of the boards without noise, each drawn once."""
    drawn = {}

    def draw(board, turn=0.3):
        if (board, turn) not in drawn:
            at = pose(board, 640, TILTED, turn)
            drawn[board, turn] = view(board, CAMERA, at), at
        return drawn[board, turn]

    return draw


def noisy(image, rng, sigma=1.5):
    return np.clip(np.rint(image + rng.normal(0, sigma, image.shape)), 0, 255).astype(np.uint8)


def truth(board, at):
    centres = CAMERA.project(rigid.apply(at, board.points()))
    if isinstance(board, Discs):
        centres += centre_offsets(CAMERA, at, board.points(), board.diameter_mm / 2)
    return centres


@pytest.mark.parametrize("board", [ASYMMETRIC, SYMMETRIC, CHESSBOARD, CHARUCO, APRILGRID], ids=lambda b: b.kind)
def test_points_lie_where_they_should_as_well_as_predicted(board, clean, rng):
    image, at = clean(board)
    errors, z = [], []
    for _ in range(4):
        found = detect(noisy(image, rng), board)
        errors.append(found.pixels - truth(board, at))
        z.append(np.linalg.solve(np.linalg.cholesky(found.covariance), errors[-1][..., None]))
    assert np.isfinite(errors).all()
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.005
    assert np.std(z) == pytest.approx(1, abs=0.25)  # 5 sigma of about 200 numbers
    assert np.std(errors) < 0.02


@pytest.mark.parametrize("board", [ASYMMETRIC, SYMMETRIC], ids=lambda b: b.kind)
def test_white_discs_on_a_dark_board(board, clean, rng):
    """The negative of an image has its discs where the image has them; a design of the other colour is named."""
    image, white = noisy(clean(board)[0], rng), board.model_copy(update={"white": True})
    assert detect(255 - image, white).pixels == pytest.approx(detect(image, board).pixels, abs=1e-3)
    with pytest.raises(BoardNotFound, match=r"white discs, by \d\d.\d %: give the board white: true"):
        detect(255 - image, board)
    with pytest.raises(BoardNotFound, match="give the board white: false"):
        detect(image, white)


@pytest.mark.parametrize("rows", [6, 7])
def test_the_order_is_the_true_one_however_the_board_is_turned(rows, rng):
    """Projected points in any order, among many that belong to nothing. With even rows half a turn is a symmetry."""
    board = AsymmetricCircles(columns=4, rows=rows, spacing_mm=15, diameter_mm=10)
    cells, steps = np.rint(board.points()[:, :2] / 15).astype(int), np.array([[1, 1], [-1, 1]])
    for turn in np.deg2rad(np.arange(0, 360, 15)):
        tilt = rng.uniform(-1, 1, 2)
        at = pose(board, 640, tilt * np.pi / 4 / np.hypot(*tilt) * rng.uniform(), turn)
        pixels = CAMERA.project(rigid.apply(at, board.points()))
        points = np.vstack([pixels, rng.uniform([-200, -100], [40, 500], (60, 2)), rng.uniform([440, -100], [580, 500], (20, 2))])
        shuffle = rng.permutation(len(points))
        found = shuffle[assign(points[shuffle], cells, steps)]
        ways = [np.arange(len(cells))] + ([np.arange(len(cells))[::-1]] if rows % 2 == 0 else [])
        assert any((found == way).all() for way in ways), np.rad2deg(turn)


def test_a_view_of_the_back_of_an_even_grid_is_mirrored(rng):
    board = AsymmetricCircles(columns=4, rows=6, spacing_mm=15, diameter_mm=10)
    pixels = CAMERA.project(rigid.apply(pose(board, 640, TILTED, 0.3), board.points())) * [-1, 1]
    with pytest.raises(BoardNotFound, match="mirrored"):
        assign(pixels, np.rint(board.points()[:, :2] / 15).astype(int), np.array([[1, 1], [-1, 1]]))


def test_grids_that_grew_alike_are_placed_once_with_the_same_outcome(rng, monkeypatch):
    """From seeds all over the points most grow into one grid, turned and shifted; placing each changes nothing but the time."""
    cells = np.argwhere(np.ones((5, 6), int))[:, ::-1]
    steps = np.array([[1, 0], [0, 1]])
    drawn = []
    for lost in (0, 0, 4, 9):
        points = 20.0 * rng.permutation(cells)[lost:] @ np.array([[1.0, 0.2], [-0.2, 1.0]]) + rng.normal(0, 0.5, (30 - lost, 2))
        drawn.append(np.concatenate([points, rng.uniform(-40, 160, (4, 2))]))
    outcomes = [placed(points, cells, steps) for points in drawn]
    numbers = iter(range(10**6))
    monkeypatch.setattr(lattice, "_form", lambda _: next(numbers))
    assert [placed(points, cells, steps) for points in drawn] == outcomes
    assert {type(outcome) for outcome in outcomes} == {list, str}


def placed(points, cells, steps):
    """The numbers of the points, or the reason for none."""
    try:
        return assign(points, cells, steps).tolist()
    except BoardNotFound as refusal:
        return str(refusal)


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=lambda b: b.kind)
def test_a_mirrored_board_of_markers_is_named(board, clean, rng):
    image = noisy(clean(board)[0], rng)
    with pytest.raises(BoardNotFound, match="image is mirrored: turn off the flip"):
        detect(np.ascontiguousarray(image[:, ::-1]), board)


@pytest.mark.parametrize(
    ("board", "given", "hint"),
    [
        (CHARUCO, {"legacy": True}, "OpenCV's newer one: give the board legacy: false"),
        (CHARUCO.model_copy(update={"legacy": True}), {"legacy": False}, "OpenCV's older one: give the board legacy: true"),
        (CHARUCO, {"columns": 4, "rows": 5}, "rows and columns exchanged"),
        (APRILGRID, {"columns": 2, "rows": 3}, "rows and columns exchanged"),
        (APRILGRID, {"border_cells": 1}, "tags have a border of 2 cells: give the board border_cells: 2"),
        (APRILGRID, {"spacing_ratio": 0.9}, "as with spacing_ratio 0.30, not 0.9"),
        (APRILGRID, {"spacing_ratio": 0.25}, "as with spacing_ratio 0.30, not 0.25"),
        (APRILGRID, {"columns": 2, "rows": 1}, "tag [2-5] isn't on a grid of 2 x 1 tags: wrong board size"),
    ],
)
def test_another_layout_is_named_with_the_field_that_takes_it(board, given, hint, clean, rng):
    image = noisy(clean(board)[0], rng)
    with pytest.raises(BoardNotFound, match=hint):
        detect(image, board.model_copy(update=given))


def test_tags_under_a_wide_lens_are_on_their_grid(rng, monkeypatch):
    """Of a lens with k1 of -0.35, 10 x 7 tags lie 0.26 tags off any map without distortion."""
    monkeypatch.setattr(board_views, "SUB", 2)  # quick, and fine enough to be found
    board = AprilGrid(columns=10, rows=7, tag_mm=50)
    camera = Camera((752, 480), np.array([[458, 0, 367], [0, 457, 248], [0, 0, 1.0]]), np.array([-0.35, 0.12, 0, 0, 0]))
    found = detect(noisy(view(board, camera, pose(board, 400, (0, 0), 0.0)), rng), board)
    assert np.isfinite(found.pixels[:, 0]).mean() > 0.8


@pytest.mark.parametrize("board", [ASYMMETRIC, CHESSBOARD, APRILGRID], ids=lambda b: b.kind)
def test_large_images_are_looked_at_reduced_and_measured_whole(board, clean, rng, monkeypatch):
    """So a photograph without a board costs no more than a small one; points are as well measured as without."""
    image = noisy(clean(board)[0], rng)
    whole = detect(image, board)
    monkeypatch.setattr(reduced_images, "LARGE_PX", 1e5)  # of 192 000
    monkeypatch.setattr(chessboard, "FEWEST_PX", 7e4)
    assert reduced_images.reduced(image).image.size <= 1e5
    np.testing.assert_allclose(detect(image, board).pixels, whole.pixels, atol=0.02)  # of 0.01 px by noise: windows differ
    at = np.array([[10.0, 20.0], [100.25, 7.5]])
    small = reduced_images.reduced(image)
    np.testing.assert_allclose(small.full((at + 0.5) / small.times - 0.5), at)


def test_exchanged_rows_and_columns_of_circles_are_named(rng):
    board = AsymmetricCircles(columns=4, rows=11, spacing_mm=10, diameter_mm=6)
    image = noisy(view(board, CAMERA, pose(board, 640, (0.2, -0.2), 0.3)), rng)
    hint = r"of 44 circles; rows and columns exchanged\? They fit columns: 4, rows: 11$"
    with pytest.raises(BoardNotFound, match=hint):
        detect(image, board.model_copy(update={"columns": 11, "rows": 4}))


def test_tags_lie_as_kalibr_prints_them():
    """Tag 0 by AprilTag's code of 36 bits, row by row from the upper left, white where set; it stands at the lower left."""
    white = np.array([int(bit) for bit in f"{0xD5D628584:036b}"], np.uint8).reshape(6, 6)
    image = np.full((300, 300), 200, np.uint8)
    image[50:250, 50:250] = 20 + 180 * np.kron(np.pad(white, 2), np.ones((20, 20), np.uint8))
    corners, numbers = aprilgrid._tags(image, border=2)
    assert numbers.tolist() == [0]
    np.testing.assert_allclose(corners[0], [[50, 50], [250, 50], [250, 250], [50, 250]], atol=2)
    assert APRILGRID.points()[APRILGRID.corners_of_tags()[0, 0]] == pytest.approx([0, 28 * 1.3, 0])


@pytest.mark.parametrize(
    "seen, expected",
    [
        (ASYMMETRIC, ASYMMETRIC.model_copy(update={"rows": 5})),
        (ASYMMETRIC, ASYMMETRIC.model_copy(update={"columns": 5})),
        (SYMMETRIC, SYMMETRIC.model_copy(update={"columns": 4})),
        (CHESSBOARD, CHESSBOARD.model_copy(update={"columns": 7})),
        (CHARUCO, CHARUCO.model_copy(update={"columns": 7})),
    ],
    ids=["fewer rows", "more columns", "fewer columns", "chessboard", "charuco"],
)
def test_a_board_of_another_size_is_refused(seen, expected, clean, rng):
    with pytest.raises(BoardNotFound, match=r"wrong board size|of 35 circles"):
        detect(noisy(clean(seen)[0], rng), expected)


def test_a_whole_grid_of_fewer_rows_is_called_so(clean, rng):
    """Rather than a board with circles missing."""
    with pytest.raises(BoardNotFound, match="found 5 x 4 circles instead of 6 x 4: wrong board size"):
        detect(noisy(clean(SYMMETRIC)[0], rng), SYMMETRIC.model_copy(update={"columns": 6}))


def test_a_row_of_charuco_corners_tells_no_pose(rng):
    """A board slides out of the image until a single row of its corners is left: six at first, on one line."""
    board = Charuco(columns=10, rows=7, square_mm=18, marker_mm=13)
    camera = Camera((480, 180), np.array([[1300, 0, 240], [0, 1300, 90], [0, 0, 1.0]]), np.zeros(4))
    for height in (-65.0, -62.0):
        image = noisy(view(board, camera, pose(board, 640, centre=(0, height))), rng)
        with pytest.raises(BoardNotFound, match="on one line"):
            detect(image, board)


@pytest.mark.parametrize("board", [Chessboard(columns=10, rows=7, square_mm=60), Chessboard(columns=9, rows=6, square_mm=60)])
def test_large_squares_are_found(board, rng, monkeypatch):
    """Full images; squares of some 75 px, as boards that fill the image have."""
    monkeypatch.setattr(board_views, "SUB", 1)  # quick, and fine enough to be found
    camera = Camera((1280, 1024), np.array([[1800, 0, 640], [0, 1800, 512], [0, 0, 1.0]]), np.array([-0.1, 0.1, 0, 0]))
    at = pose(board, rng.uniform(1400, 1600), rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.2, 0.2), rng.uniform(-30, 30, 2))
    found = detect(view(board, camera, at, noise=1.0, rng=rng), board)
    assert np.abs(found.pixels - camera.project(rigid.apply(at, board.points()))).max() < 0.5


def test_a_chessboard_in_part_is_not_called_a_board_of_another_size(clean, rng):
    image, _ = clean(CHESSBOARD, 0.0)
    rows = truth(CHESSBOARD, pose(CHESSBOARD, 640, TILTED, 0.0)).reshape(5, 6, 2)[..., 1]
    below = (rows[2].max() + rows[3].min()) / 2
    cut, covered = noisy(image, rng)[: int(below)], noisy(image, rng)
    covered[int(below) :] = 120
    for part in (cut, covered):
        with pytest.raises(BoardNotFound, match=r"found \d x \d of 6 x 5 inner corners"):
            detect(part, CHESSBOARD)


@pytest.mark.parametrize("name", ["CORNER_REFINE_NONE", "5X5_100"])
def test_only_dictionaries_are_taken_for_dictionaries(name):
    with pytest.raises(ValidationError, match="DICT_"):
        Charuco(columns=5, rows=4, square_mm=26, marker_mm=18, dictionary=name)


def test_an_unknown_dictionary_is_named():
    board = Charuco(columns=5, rows=4, square_mm=26, marker_mm=18, dictionary="DICT_9X9_7")
    with pytest.raises(InputError, match=r"^dictionary: expected one of OpenCV's, such as DICT_5X5_100, found 'DICT_9X9_7'$"):
        detect(np.zeros((90, 120)), board)


def test_a_part_of_a_charuco_board_is_enough(clean, rng):
    image, at = clean(CHARUCO)
    covered = noisy(image, rng)
    covered[:, :170] = 120
    found = detect(covered, CHARUCO)
    seen = np.isfinite(found.pixels[:, 0])
    assert 6 <= seen.sum() < len(seen)
    np.testing.assert_allclose(found.pixels[seen], truth(CHARUCO, at)[seen], atol=0.1)


def test_uneven_light_clutter_and_another_depth_are_no_matter(clean, rng):
    """12 bits, a shadow that leaves a fifth of the light, and dark things beside the board."""
    image, at = clean(ASYMMETRIC)
    light = np.linspace(0.2, 1.2, image.shape[1])[None]
    for u, v in rng.uniform([10, 10], [60, 390], (8, 2)):
        cv2.circle(image := image.copy(), (int(u), int(v)), 9, 40, -1, cv2.LINE_AA)
    found = detect(np.rint(noisy(image, rng) * light * 16).astype(np.uint16), ASYMMETRIC, full=4095)
    assert np.abs(found.pixels - truth(ASYMMETRIC, at)).max() < 0.1


def test_glare_on_a_few_rims_costs_these_discs_only(clean, rng):
    image, at = clean(ASYMMETRIC)
    centres = truth(ASYMMETRIC, at)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    glare = 400 * np.exp(-((u - centres[9, 0] - 8) ** 2 + (v - centres[9, 1]) ** 2) / 2 / 6**2)
    found = detect(noisy(image + glare, rng), ASYMMETRIC)
    seen = np.isfinite(found.pixels[:, 0])
    assert not seen[9] and seen.sum() >= 24
    error = (found.pixels - centres)[seen]
    deviation = np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance[seen]), error))
    assert deviation.max() < 6


def blurred(image):
    return cv2.GaussianBlur(image, (0, 0), 4)


def cut(image):
    return image[:, :230]


def dim(image):
    return 2 + image * 0.03


def overexposed(image):
    return image * 1.6


@pytest.mark.parametrize(
    "fault, reason",
    [(blurred, "blurred"), (cut, "of 28 circles"), (dim, "contrast|of 28 circles"), (overexposed, "saturated")],
)
def test_a_badly_seen_board_is_refused_with_the_reason(fault, reason, clean, rng):
    with pytest.raises(BoardNotFound, match=reason):
        detect(noisy(fault(clean(ASYMMETRIC)[0]), rng), ASYMMETRIC)


@pytest.mark.parametrize("board", [ASYMMETRIC, SYMMETRIC, CHESSBOARD, CHARUCO], ids=lambda b: b.kind)
@pytest.mark.parametrize("level", [0, 128, 255])
def test_an_empty_image_has_no_board(board, level, rng):
    with pytest.raises(BoardNotFound, match="found"):
        detect(noisy(np.full((300, 400), float(level)), rng), board)


@pytest.mark.parametrize("turn", [0.3, 2.0, 4.0])
@pytest.mark.parametrize("board", [SYMMETRIC, CHESSBOARD], ids=lambda b: b.kind)
def test_a_grid_is_never_mirrored_and_begins_in_the_same_place(board, turn, clean, rng):
    """The chessboard's colours tell its first corner; a symmetric grid begins at the upper left, so half a turn is undone."""
    image, at = clean(board, turn)
    found, expected = detect(noisy(image, rng), board).pixels, truth(board, at)
    if board is SYMMETRIC and expected[0].sum() > expected[-1].sum():
        expected = expected[::-1]
    np.testing.assert_allclose(found, expected, atol=0.15)
