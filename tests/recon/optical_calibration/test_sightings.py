"""From the images of one pose to where each device sees the board, on synthetic photographs."""

import numpy as np
import pytest

from recon.board_detection.kinds.aprilgrid import AprilGrid
from recon.board_detection.kinds.chessboard import Chessboard
from recon.capture.board_part import read_board
from recon.capture.manifest import BoardPart, Device
from recon.capture.writer import new_capture, write_pose
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.patterns import Fringes, GrayCode, Patterns, Uniform
from recon.optical_calibration import board_frames, sightings
from recon.optical_calibration.sightings import Cause, sight
from recon.structured_light import surface_figures
from recon.structured_light.decode import Linearity
from recon.structured_light.phase_bend import Bend, by_harmonics, gamma_of
from tests.recon.board_views import pose, under_patterns, view

BOARD = Chessboard(columns=5, rows=4, square_mm=28)
CAMERA = Camera((320, 256), np.array([[830.0, 0, 158], [0, 832, 127], [0, 0, 1]]), np.zeros(4))
PROJECTOR = Camera(
    (256, 160),
    np.array([[560.0, 0, 127], [0, 560, 80], [0, 0, 1]]),
    np.zeros(4),
    rigid.from_rotation_vector(np.deg2rad([0, -15, 0]), [172.0, 4, 45]),
)
PATTERNS = Patterns(
    projector_size=PROJECTOR.size,
    unwrap="gray",
    parts=tuple(
        part
        for axis in ("columns", "rows")
        for part in (Fringes(axis=axis, pitch=16, steps=8), GrayCode(axis=axis, pitch=16, bits=4))
    ),
)


@pytest.mark.parametrize("bits", [8, 10])
def test_images_of_any_depth_tell_the_points_of_camera_and_projector(bits, rng):
    """The same light in finer steps: the points lie where they should, and as well as is said."""
    world_from_board = pose(BOARD, 640, (0.3, -0.25), 0.1)
    photographs = under_patterns(BOARD, CAMERA, PROJECTOR, PATTERNS, world_from_board, rng, bits)
    found = sight("00", BOARD, {"cam1": photographs[0]}, photographs[1:], PATTERNS, {"cam1": bits})
    check(found, world_from_board)
    error = camera_error(found, world_from_board)
    assert np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance["cam1"]), error)) < 4


@pytest.mark.parametrize("board", [BOARD, AprilGrid(columns=3, rows=2, tag_mm=35)], ids=["chessboard", "aprilgrid"])
def test_fringes_are_left_alone_where_the_projector_isnt_calibrated(board, rng):
    image = view(board, CAMERA, pose(board, 640, (0.3, -0.25), 0.1), noise=1.0, rng=rng)
    found = sight("00", board, {"cam1": image}, np.stack([image] * 3), None, {"cam1": 8})
    assert list(found.pixels) == ["cam1"] and np.isfinite(found.pixels["cam1"]).all() and not found.failures


def test_the_mean_of_the_fringes_stands_in_for_a_lit_image(tmp_path, rng):
    """A capture whose poses hold nothing but the projected sequence gives points as exact as with a lit image."""
    world_from_board = pose(BOARD, 640, (0.3, -0.25), 0.1)
    stack = under_patterns(BOARD, CAMERA, PROJECTOR, PATTERNS, world_from_board, rng)[1:]
    devices = {"cam1": Device(size=CAMERA.size), "projector": Device(size=PROJECTOR.size)}
    with new_capture(tmp_path / "capture") as capture:
        records = (write_pose(capture.folder, "00", {}, {"cam1": stack}),)
        capture.add_board(BoardPart(board=BOARD, patterns=PATTERNS, poses=records), devices)
    (found,) = board_frames.look_at_all(read_board(tmp_path / "capture"))
    check(found, world_from_board)


@pytest.mark.parametrize("inverted", [True, False], ids=["with inverses", "with black and white"])
def test_gray_code_alone_gives_the_projector_its_points(inverted, rng):
    """Both axes to the pixel: hundreds of cells about a point place it to a tenth of one, and as well as is said."""
    world_from_board = pose(BOARD, 640, (0.3, -0.25), 0.1)
    code = [GrayCode(axis=axis, pitch=1, bits=8, inverted=inverted) for axis in ("columns", "rows")]
    parts = code if inverted else [Uniform(), *code, Uniform(level=0)]
    patterns = Patterns(projector_size=PROJECTOR.size, unwrap="gray", parts=tuple(parts))
    photographs = under_patterns(BOARD, CAMERA, PROJECTOR, patterns, world_from_board, rng)
    found = sight("00", BOARD, {"cam1": photographs[0]}, photographs[1:], patterns, {"cam1": 8})
    check(found, world_from_board, most_px=0.2)
    expected = PROJECTOR.project(rigid.apply(world_from_board, BOARD.points()))
    error = found.pixels["projector"] - expected - np.einsum("nij,nj->ni", found.gradient, camera_error(found, world_from_board))
    assert 0.3 < np.nanmean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance["projector"]), error)) < 4


def test_a_failure_has_its_cause(rng):
    """A camera that sees no board, a code of a larger projector, and images in another order."""
    world_from_board = pose(BOARD, 640, (0.3, -0.25), 0.1)
    code = tuple(GrayCode(axis=axis, pitch=1, bits=8, inverted=True) for axis in ("columns", "rows"))
    patterns = Patterns(projector_size=PROJECTOR.size, unwrap="gray", parts=code)
    first, *photographs = under_patterns(BOARD, CAMERA, PROJECTOR, patterns, world_from_board, rng)
    lit, coded = {"cam1": first}, np.stack(photographs)
    width, height = PROJECTOR.size
    smaller = patterns.model_copy(update={"projector_size": (width // 4, height // 4)})
    for shown, images, cause in ((smaller, coded, Cause.CODE_OUTSIDE), (patterns, coded[::-1], Cause.UNDECODED)):
        failures = sight("00", BOARD, lit, images, shown, {"cam1": 8}).failures
        assert {device: failure.cause for device, failure in failures.items()} == {"projector": cause}
    (failure,) = sight("00", BOARD, {"cam1": np.zeros_like(first)}, None, None, {"cam1": 8}).failures.values()
    assert failure.cause is Cause.NO_BOARD


def test_the_light_of_all_poses_is_told_once_by_the_largest_bend():
    parts = Fringes(pitch=16, steps=3), Fringes(pitch=200, steps=3)
    seen = []
    for c in (0.1, 0.25, 0.15):
        bends = (Bend(by_harmonics(3, c, 0.0), 3, 16.0, 0.01, gamma_of(3, c)),) * 2  # of columns and rows
        light = Linearity(bends, ((parts[1], "few"),), clipped=c)
        seen.append(sightings.Sighting("00", {}, {}, np.zeros((0, 2, 2)), linearity=light))
    found = sightings.light(seen)
    assert [bend.gamma for bend in found.bends] == [gamma_of(3, 0.25)] and found.clipped == 0.25
    bent, unseen = surface_figures.bent(found)
    assert "level^2.0 or so (25 % of the samples are 0: is black clipped" in bent and "3 steps of 16 px were bent" in bent
    assert "3 steps of 200 px would be bent by a gamma, which too few periods are seen to show" in unseen


def camera_error(found, world_from_board):
    return found.pixels["cam1"] - CAMERA.project(rigid.apply(world_from_board, BOARD.points()))


def check(found, world_from_board, most_px=0.1):
    """Camera 1 and projector see most points, to a tenth of a pixel."""
    assert not found.failures
    truth = rigid.apply(world_from_board, BOARD.points())
    for name, camera in (("cam1", CAMERA), ("projector", PROJECTOR)):
        error = found.pixels[name] - camera.project(truth)
        known = np.isfinite(error).all(axis=1)
        assert known.mean() > 0.8 and np.abs(error[known]).max() < most_px, name


def test_the_decoded_part_holds_all_windows():
    """With a margin, within the image; a point that isn't seen doesn't count."""
    centres = np.array([[100.0, 60.0], [200.5, 90.0], [np.nan, np.nan]])
    rows, columns = sightings._around(centres, np.array([10.0, 12.0, 1.0]), PATTERNS, (256, 320))
    margin = sightings.MARGIN
    assert (rows.start, rows.stop) == (50 - margin, 102 + margin + 1)
    assert (columns.start, columns.stop) == (90 - margin, 213 + margin + 1)
    rows, columns = sightings._around(centres, np.full(3, 1000.0), PATTERNS, (256, 320))
    assert (rows, columns) == (slice(0, 256), slice(0, 320))


def test_with_a_centre_line_the_whole_image_is_decoded():
    """The line may fall beside the board, on what it stands on."""
    line = PATTERNS.model_copy(update={"unwrap": "centre_line"})
    assert sightings._around(np.array([[100.0, 60.0]]), np.array([5.0]), line, (256, 320)) == (slice(0, 256), slice(0, 320))


def test_points_without_a_known_distance_are_refused_by_the_cause():
    with pytest.raises(InputError, match="more than one row"):
        sightings._around(np.array([[100.0, 60.0], [120.0, 60.0]]), np.array([np.nan, np.inf]), PATTERNS, (256, 320))
