"""Errors of circles' centres and of poses, beside the physical limit and the published recipe."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.rig import Target
from recon.tracking import circle_detector, circle_segmenter
from recon.tracking import networks as nets
from recon.tracking.networks import DETECTOR_SIZE, Networks
from recon.tracking.tracker import Tracker
from twin.experiments import tracking_frames
from twin.experiments.baselines import published
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.tracking_frames import exactly_printed
from twin.sensor import Exposure, noise_dn, number_per_electron
from twin.tracking.rendered_views import Frames
from twin.tracking.samples import Take
from twin.tracking.target_truth import ViewTruth

Array = NDArray[np.float64]
Pair = tuple[Camera, Camera]
Images = tuple[NDArray[np.uint8], NDArray[np.uint8]]
Locate = Callable[[Pair, Images], Array | None]  # from two frames to world_from_target : (4, 4) mm, or None

SEED = 2002
LIT_DN, COUNT, BLURRED = 120.0, 40, 12  # frames of the static study, and of each other blur
MANY = 0.5  # of the poses, of which a ratio of medians is told
FINE = 64  # rays a pixel, so that rendering's noise is small beside the sensor's where covariances are tested


@dataclass(frozen=True)
class Located:
    """Errors of one stereo frame's result, or nothing."""

    centre_px: Array  # (6,) distance of each circle's centre from the true ellipse's; NaN if not found
    limit_px: Array  # (6,) RMS of that distance that noise alone would leave
    shift_mm: float
    turn_deg: float
    misfit: float  # squared error of the pose over its covariance, chi-square with 6 degrees; NaN if not found


def moving_centres(setup: Setup, blur_px: float) -> Figures:
    """Median error of centres in motion."""
    setup, known = exactly_printed(setup), nets.load(kind=setup.rig.target.kind)
    shown = tracking_frames.study(setup, SEED, BLURRED, LIT_DN, blur_px)
    return centres([located(take, given, setup.rig.target, known) for take, given in shown])


def centres(errors: Sequence[Located]) -> Figures:
    """Median error of centres, beside that of noise alone."""
    found = np.concatenate([one.centre_px for one in errors])
    limit = np.median(np.concatenate([one.limit_px for one in errors]))
    share = 100 * np.isfinite(found).mean()
    return {"centre_px": np.nanmedian(found), "limit_px": limit, "circles": len(found), "circles_percent": share}


def poses_at_rest(setup: Setup) -> Figures:
    """Errors of centres and poses, static and lit, over the working volume; whether covariances hold."""
    setup, known = exactly_printed(setup), nets.load(kind=setup.rig.target.kind)
    sample = list(tracking_frames.study(setup, SEED, COUNT, LIT_DN, 0.0, FINE))
    errors = [located(take, given, setup.rig.target, known) for take, given in sample]
    shift, turn, misfit = (np.array([getattr(one, name) for one in errors]) for name in ("shift_mm", "turn_deg", "misfit"))
    misfit = misfit[np.isfinite(misfit)]
    return centres(errors) | {
        "poses": len(sample),
        "shift_mm": np.nanmedian(shift),
        "shift_mm_95": np.nanpercentile(shift, 95),
        "turn_deg": np.nanmedian(turn),
        "turn_deg_95": np.nanpercentile(turn, 95),
        "found_percent": 100 * np.isfinite(shift).mean(),
        "squared": misfit.mean(),
        "inside_percent": 100 * np.mean(misfit < chi2.ppf(0.95, 6)),
    }


def beside_recipe(setup: Setup, white_dn: float, blur_px: float) -> Figures:
    """Poses by us and by the published recipe, of the same networks in the same frames; ratios of those that both find."""
    setup, known = exactly_printed(setup), nets.load(kind=setup.rig.target.kind)
    sample = list(tracking_frames.study(setup, SEED, COUNT, white_dn, blur_px))
    results, locate = [located(take, given, setup.rig.target, known) for take, given in sample], published_recipe(known)
    recipe = [pose_errors(take, locate(cameras_of(take), given.views)) for take, given in sample]
    ours = np.array([(one.shift_mm, one.turn_deg) for one in results])
    theirs = np.array([(np.nan, np.nan) if one is None else one for one in recipe])
    both = np.isfinite(ours[:, 0]) & np.isfinite(theirs[:, 0])
    figures: Figures = {"pairs": len(sample)}
    for name, errors in (("ours", ours), ("recipe", theirs)):
        found = errors[np.isfinite(errors[:, 0])]
        figures |= {f"{name}_found": len(found)} | ({f"{name}_mm": np.median(found[:, 0])} if len(found) else {})
    if np.mean(both) > MANY:
        shift, turn = np.median(theirs[both], axis=0) / np.median(ours[both], axis=0)
        figures |= {"shift_ratio": shift, "turn_ratio": turn}
    return figures


def located(take: Take, given: Frames, target: Target, networks: Networks) -> Located:
    """Track one sample as if nothing were known before."""
    cameras = cameras_of(take)
    result = Tracker(cameras, target, networks, drift_px=0, board_scale=0).step(*given.views)
    truth = np.concatenate([view.ellipses[:, :2] for view in given.truth])
    limit = np.concatenate([centre_limit(take, camera, view, target) for camera, view in zip((0, 1), given.truth, strict=True)])
    nothing = Located(np.full(6, np.nan), limit, np.nan, np.nan, np.nan)
    if not result.found:
        return nothing
    seen = [view.outlines.sighting(camera).centres for view, camera in zip(result.views, cameras, strict=True)]
    shift, turn = pose_errors(take, result.pose.world_from_target) or (np.nan, np.nan)
    error = rigid.difference(take.motion.world_from_target, result.pose.world_from_target)
    misfit = float(error @ np.linalg.solve(result.pose.covariance, error))
    return Located(np.linalg.norm(np.concatenate(seen) - truth, axis=1), limit, shift, turn, misfit)


def cameras_of(take: Take) -> Pair:
    """Both calibrated cameras."""
    first, second = (device.optics.camera() for device in take.cameras)
    return first, second


def pose_errors(take: Take, found: Array | None) -> tuple[float, float] | None:
    """Errors of the origin, mm, and of the axes, deg: the nearest rotation where the found matrix isn't one."""
    if found is None or not np.isfinite(found).all():
        return None
    left, _, right = np.linalg.svd(found[:3, :3])
    nearest = np.eye(4)
    nearest[:3, :3], nearest[:3, 3] = left @ right, found[:3, 3]
    error = rigid.difference(take.motion.world_from_target, nearest)
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


def published_recipe(networks: Networks) -> Locate:
    """Masks' contours, ellipses' centres as circles' centres, triangulation, axes from differences."""

    def locate(cameras: Pair, images: Images) -> Array | None:
        small = np.stack([circle_detector.network_image(image) for image in images])
        places, identities = networks.detect(small)
        centres = []
        for image, place, identity in zip(images, places, identities, strict=True):
            found = published.candidates(place, identity)
            if found is None:
                return None
            full = (image.shape[1], image.shape[0])
            cut = circle_segmenter.patches(image, found * (np.array(full) / DETECTOR_SIZE))
            origins = published.patch_origins(found, DETECTOR_SIZE, full)
            centres.append(published.centres_from_logits(networks.segment(cut.images), origins))
        return published.pose_from_centres(centres[0], centres[1], *cameras)

    return locate
