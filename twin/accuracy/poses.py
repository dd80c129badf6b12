"""Errors of circles' centres and of poses, over light and blur, beside the physical limit, the published recipe and rivals."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon.camera import Camera
from recon.rig import Target
from recon.tracking import classical, detection, fiducials, published, segmentation
from recon.tracking.networks import DETECTOR_SIZE, Networks
from recon.tracking.pose import Sighting, estimate
from recon.tracking.tracker import Tracker
from twin.accuracy import frames
from twin.accuracy.rows import Row, Setup
from twin.sensor import Exposure, noise_dn, number_per_electron
from twin.tracking.draw import Take
from twin.tracking.frames import Frames
from twin.tracking.prints import BitGrid
from twin.tracking.truth import ViewTruth

Array = NDArray[np.float64]
Pair = tuple[Camera, Camera]
Images = tuple[NDArray[np.uint8], NDArray[np.uint8]]
Locate = Callable[[Pair, Images], Array | None]  # from two frames to world_from_target : (4, 4) mm, or None

SEED = 2002
LIT_DN, COUNT, BLURRED = 120.0, 100, 40  # frames of the static study, and of each other blur
FINE = 128  # rays a pixel, so that rendering's noise is small beside the sensor's where covariances are tested
BLURS = (0.0, 4.0, 8.0, 12.0, 16.0)
GRID_WHITE, GRID_BLUR, GRID_COUNT = (6.0, 12.0, 25.0, 60.0, 150.0), (0.0, 4.0, 8.0, 12.0, 20.0), 6


@dataclass(frozen=True)
class Located:
    """One stereo frame: errors of what was found, or nothing."""

    centre_px: Array  # (6,) distance of each circle's centre from the true ellipse's; NaN if not found
    limit_px: Array  # (6,) RMS of that distance that noise alone would leave
    shift_mm: float
    turn_deg: float
    misfit: float  # squared error of the pose over its covariance, chi-square with 6 degrees; NaN if not found


def centre_rows(setup: Setup, networks: Networks) -> list[Row]:
    """Median errors of centres, still and moving."""
    result = []
    for blur in BLURS:
        count = COUNT if blur == 0 else BLURRED
        errors = [
            located(take, given, setup.rig.target, networks) for take, given in frames.study(setup, SEED, count, LIT_DN, blur)
        ]
        centres = np.concatenate([one.centre_px for one in errors])
        limit = np.concatenate([one.limit_px for one in errors])
        bar = {0.0: 0.02, 16.0: 0.25}.get(blur, 0.15)
        share = 100 * np.isfinite(centres).mean()
        what = f"centre error at {blur:g} px blur, white 120, median of {len(centres)} circles ({share:.0f} % found)"
        result.append(Row("c", what, float(np.nanmedian(centres)), bar, float(np.median(limit)), "px"))
    return result


def pose_rows(setup: Setup, networks: Networks) -> list[Row]:
    """Errors of poses, static and lit, over the working volume; whether the covariance holds; the published recipe's."""
    sample = list(frames.study(setup, SEED, COUNT, LIT_DN, 0.0, FINE))
    target = setup.rig.target
    errors = [located(take, given, target, networks) for take, given in sample]
    recipe = [pose_errors(take, published_recipe(networks)(cameras_of(take), given.views)) for take, given in sample]
    shift, turn = np.array([one.shift_mm for one in errors]), np.array([one.turn_deg for one in errors])
    theirs = np.array([(np.nan, np.nan) if one is None else one for one in recipe])
    both = np.isfinite(shift) & np.isfinite(theirs[:, 0])
    ratio = np.median(theirs[both], axis=0) / [np.median(shift[both]), np.median(turn[both])]
    misfit = np.array([one.misfit for one in errors])
    known = misfit[np.isfinite(misfit)]
    of = f"static, lit, {len(sample)} poses"
    inside = 100 * np.mean(known < chi2.ppf(0.95, 6))
    return [
        Row("d", f"translation, {of}: median", float(np.nanmedian(shift)), 0.04, None, "mm"),
        Row("d", f"translation, {of}: 95th percentile", float(np.nanpercentile(shift, 95)), 0.10, None, "mm"),
        Row("d", f"rotation, {of}: median", float(np.nanmedian(turn)), 0.08, None, "deg"),
        Row("d", f"rotation, {of}: 95th percentile", float(np.nanpercentile(turn, 95)), 0.20, None, "deg"),
        Row("d", f"poses found, {of}", 100 * np.isfinite(shift).mean(), 99.0, None, "%", at_least=True),
        Row("d", "squared error over covariance, chi-square of 6: mean", float(known.mean()), 7.5, 6.0, ""),
        Row("d", "errors within the 95 % region that the covariance gives", float(inside), 90.0, 95.0, "%", at_least=True),
        Row("e", f"published recipe, same frames and networks ({both.sum()} found by both): translation, median, times ours",
            float(ratio[0]), 2.0, None, "x", at_least=True),
        Row("e", "published recipe: rotation, median, times ours", float(ratio[1]), 2.0, None, "x", at_least=True),
    ]  # fmt: skip


def located(take: Take, given: Frames, target: Target, networks: Networks) -> Located:
    """Track one sample as if nothing were known before."""
    cameras = cameras_of(take)
    result = Tracker(cameras, target, networks).step(*given.views)
    truth = np.concatenate([view.ellipses[:, :2] for view in given.truth])
    limit = np.concatenate([centre_limit(take, camera, view, target) for camera, view in zip((0, 1), given.truth, strict=True)])
    nothing = Located(np.full(6, np.nan), limit, np.nan, np.nan, np.nan)
    if not result.found:
        return nothing
    centres = np.concatenate([view.outlines.ellipses.centre for view in result.views])
    shift, turn = pose_errors(take, result.pose.world_from_target) or (np.nan, np.nan)
    error = pose_difference(take.motion.world_from_target, result.pose.world_from_target)
    misfit = float(error @ np.linalg.solve(result.pose.covariance, error))
    return Located(np.linalg.norm(centres - truth, axis=1), limit, shift, turn, misfit)


def cameras_of(take: Take) -> Pair:
    """Both calibrated cameras."""
    first, second = (device.optics.camera() for device in take.cameras)
    return first, second


def pose_difference(truth: Array, found: Array) -> Array:
    """Turn (rad) in the world and shift (mm) from a true pose to a found one : (6,), as `TargetPose.covariance` has them."""
    turn = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([turn, found[:3, 3] - truth[:3, 3]])


def pose_errors(take: Take, found: Array | None) -> tuple[float, float] | None:
    """Errors of the origin, mm, and of the axes, deg: the nearest rotation where the found matrix isn't one."""
    if found is None or not np.isfinite(found).all():
        return None
    left, _, right = np.linalg.svd(found[:3, :3])
    nearest = np.eye(4)
    nearest[:3, :3], nearest[:3, 3] = left @ right, found[:3, 3]
    error = pose_difference(take.motion.world_from_target, nearest)
    return float(np.linalg.norm(error[3:])), float(np.rad2deg(np.linalg.norm(error[:3])))


def centre_limit(take: Take, camera: int, truth: ViewTruth, target: Target) -> Array:
    """RMS distance : (3,) px by which noise alone moves a circle's centre: `(n/C) sqrt(2 sqrt(pi) s / (pi R))` along each axis.

    The edge is blurred by the lens and the pixel, s^2 = blur^2 + 1/12, and by the motion across the rim, on average
    half of the path's variance, path^2 / 24.
    """
    device = take.cameras[camera]
    exposure = Exposure(1.0, take.gain)
    gain = number_per_electron(device.sensor, exposure)
    levels = np.array([truth.white_dn, truth.white_dn * take.face.ink / take.face.paper])
    noise = np.sqrt(np.mean(noise_dn(np.float32(levels / gain), device.sensor, exposure) ** 2))
    blur = np.sqrt(device.lens.blur_px**2 + 1 / 12 + truth.blur_px**2 / 24)
    radius = np.sqrt(truth.ellipses[:, 2] * truth.ellipses[:, 3])
    axis = noise / (levels[0] - levels[1]) * np.sqrt(2 * np.sqrt(np.pi) * blur / (np.pi * radius))
    return np.sqrt(2) * axis


def ours(target: Target, networks: Networks) -> Locate:
    """The tracker, knowing nothing before."""

    def locate(cameras: Pair, images: Images) -> Array | None:
        result = Tracker(cameras, target, networks).step(*images)
        return result.pose.world_from_target if result.found else None

    return locate


def classic(target: Target) -> Locate:
    """Threshold, contours, ellipses and geometry in each view, then our pose."""

    def locate(cameras: Pair, images: Images) -> Array | None:
        seen = [classical.find(image, target) for image in images]
        if not all(view.found for view in seen):
            return None
        first, second = (Sighting(camera, view.centres, view.covariance) for camera, view in zip(cameras, seen, strict=True))
        result = estimate(first, second, target)
        return result.world_from_target if result.found else None

    return locate


def marked(board: fiducials.Board) -> Locate:
    """A board of markers in the target's place."""

    def locate(cameras: Pair, images: Images) -> Array | None:
        first, second = (fiducials.sight(image, camera, board) for image, camera in zip(images, cameras, strict=True))
        result = fiducials.estimate(first, second, board)
        return result.world_from_target if result.found else None

    return locate


def published_recipe(networks: Networks) -> Locate:
    """Masks' contours, ellipses' centres as circles' centres, triangulation, axes from differences."""

    def locate(cameras: Pair, images: Images) -> Array | None:
        small = np.stack([detection.network_image(image) for image in images])
        places, identities = networks.detect(small)
        centres = []
        for image, place, identity in zip(images, places, identities, strict=True):
            found = published.candidates(place, identity)
            if found is None:
                return None
            full = (image.shape[1], image.shape[0])
            cut = segmentation.patches(image, found * (np.array(full) / DETECTOR_SIZE))
            origins = published.patch_origins(found, DETECTOR_SIZE, full)
            centres.append(published.centres_from_logits(networks.segment(cut.images), origins))
        return published.pose_from_centres(centres[0], centres[1], *cameras)

    return locate


def grid_rows(setup: Setup, networks: Networks) -> list[Row]:
    """What else one could pick, over light and blur: share of poses found and their median errors, in all cells of the grid."""
    target = setup.rig.target
    aruco, april = fiducials.aruco_board(target), fiducials.apriltag_board(target)
    choices: Sequence[tuple[str, Locate, BitGrid | None]] = (
        ("ours", ours(target, networks), None),
        ("classical", classic(target), None),
        ("ArUco board", marked(aruco), bits(aruco)),
        ("AprilTag board", marked(april), bits(april)),
    )
    result = []
    for white in GRID_WHITE:
        for blur in GRID_BLUR:
            cache: dict[int, list[tuple[Take, Frames]]] = {}
            for name, locate, grid in choices:
                key = 0 if grid is None else id(grid)
                if key not in cache:
                    cache[key] = list(frames.study(setup, SEED + 1, GRID_COUNT, white, blur, 8, grid))
                errors = [pose_errors(take, locate(cameras_of(take), given.views)) for take, given in cache[key]]
                result += cell_rows(name, white, blur, errors)
    return result


def cell_rows(name: str, white: float, blur: float, errors: Iterable[tuple[float, float] | None]) -> list[Row]:
    """Rows of one choice in one cell of the grid; nothing is asked of them."""
    errors = list(errors)
    good = np.array([one for one in errors if one is not None and one[0] < 5]).reshape(-1, 2)
    what = f"{name}, white {white:g}, blur {blur:g} px"
    rate = Row("f", f"{what}: found", 100 * len(good) / len(errors), 0, None, "%", at_least=True)
    if not len(good):
        return [rate]
    return [
        rate,
        Row("f", f"{what}: translation, median", float(np.median(good[:, 0])), np.inf, None, "mm"),
        Row("f", f"{what}: rotation, median", float(np.median(good[:, 1])), np.inf, None, "deg"),
    ]


def bits(board: fiducials.Board) -> BitGrid:
    """A marker board's face, for the twin to print."""
    x, y = (float(value) for value in board.origin_mm)
    return BitGrid(board.cells, (x, y), (board.cell_mm, board.cell_mm))
