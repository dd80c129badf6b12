"""Sanity checks of the optics calibration: refusals, and warnings that name a cause."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise
from recon.geometry.lens_domain import is_one_to_one
from recon.model import lengths
from recon.model.boards import Board, Discs
from recon.model.calibration import WORLD
from recon.optical_calibration.adjustment import Adjustment
from recon.optical_calibration.bundle import Array, Estimate
from recon.optical_calibration.observations import PROJECTOR, Observations

FEWEST_POSES = 3
FEW_POSES = 10
LEAST_TILT_DEG = 5.0  # between two boards, without which focal length and distance are one unknown
STRETCHED = 0.02  # of fx / fy from 1; square pixels and ordinary lenses stay within 0.005
SURE = 5.0  # standard deviations likewise
COVERED = 0.5  # least share of the image within the points' hull
FAR_OFF = 0.15  # of the image's side, from it to the nearest point
DIAMETER_REFUSED, DIAMETER_DOUBTED = 0.04, 0.015  # relative error of the discs' size; ink spreads by up to 1 %
NOISY = 3.0  # times the predicted noise
UPSIDE_DOWN = -0.5  # cosine of a roll against the first camera
UNSURE_FOCAL = 2e-3  # relative standard deviation of a focal length; 0.2 % is 1.4 mm at 700 mm


def refuse_unusable(observations: Observations, name: str) -> None:
    """Refuse captures that say too little or contradict themselves.

    Raises
    ------
    InputError
        If there are too few poses, or a device sees the board mirrored.
    """
    for number, device in enumerate(observations.devices):
        poses = int(observations.seen[:, :, number].any(axis=1).sum())
        if poses < FEWEST_POSES:
            raise InputError(f"{name}: expected {FEWEST_POSES} poses of the board or more for {device}, found {poses}")
        if device != PROJECTOR and np.mean(handedness(observations, number) < 0) > 0.5:
            raise InputError(f"{name}: expected {device} to see the board's front, found it mirrored: is the image flipped?")
    if PROJECTOR in observations.devices:
        turned = np.linalg.det(observations.gradient)[observations.seen[:, :, observations.devices.index(PROJECTOR)]]
        if np.mean(turned < 0) > 0.5:
            raise InputError(
                f"{name}: expected camera 1 and projector to see the board alike, found one of them mirrored: "
                "is the camera's or the projector's image flipped?"
            )


def handedness(observations: Observations, number: int) -> Array:
    """Of the map from the board to a device's image, by poses that it sees : +1, or -1 if it is mirrored."""
    signs = []
    for pixels in observations.pixels[:, :, number]:
        known = np.isfinite(pixels).all(axis=1)
        if known.sum() >= 3:
            plane = np.column_stack([observations.points[known, :2], np.ones(known.sum())])
            signs.append(np.sign(np.linalg.det(np.linalg.lstsq(plane, pixels[known], rcond=None)[0][:2])))
    return np.array(signs)


def refuse_parallel(observations: Observations, start: Estimate, name: str) -> None:
    """Refuse boards that are all parallel: focal length and distance can't be told apart.

    The directions are those of a first estimate. Parallel boards come out parallel whatever its focal length.

    Raises
    ------
    InputError
        If no two boards are tilted against each other.
    """
    normals = start.poses[:, :3, 2]
    tilt = float(np.rad2deg(np.arccos(np.clip(normals @ normals.T, -1, 1))).max())
    if tilt < LEAST_TILT_DEG:
        raise InputError(
            f"{name}: expected boards tilted against each other by {LEAST_TILT_DEG:g} deg or more, found all within "
            f"{tilt:.1f} deg: focal length and distance can't be told apart"
        )


def refuse_wrong_size(board: Board, radii: Sequence[Mapping[str, Array]], start: Estimate, name: str) -> str | None:
    """Compare the discs' size with the design: nothing else in the images shows a wrong spacing.

    radii : pose by pose, camera -> (n, 2) px, semi-axes of the discs' images.

    Returns
    -------
    str or None
        A warning, if the sizes differ a little; nothing of boards without discs, or whose sizes weren't measured.

    Raises
    ------
    InputError
        If they differ by more than any printer's ink spreads.
    """
    if not isinstance(board, Discs):
        return None
    ratios = []
    for pose, found in zip(start.poses, radii, strict=True):
        for device in found.keys() & start.cameras.keys():
            lines = linearise(start.cameras[device], rigid.apply(pose, start.points), ())
            magnified = np.abs(np.linalg.det(lines.by_point @ pose[:3, :2]))  # px^2 / mm^2 on the board
            ratios.append(np.sqrt(found[device].prod(axis=1) / magnified) / (board.diameter_mm / 2))
    if not ratios:
        return None
    ratio = float(np.nanmedian(np.concatenate(ratios)))
    designed = board.diameter_mm / board.spacing_mm
    measured = ratio * designed
    text = f"discs of {measured:.3f} times the spacing, where diameter_mm / spacing_mm is {designed:.3f}"
    if abs(ratio - 1) > DIAMETER_REFUSED:
        raise InputError(f"{name}: board: found {text}: spacing_mm or diameter_mm is wrong, and with it all lengths may be")
    return f"{text}: measure the board" if abs(ratio - 1) > DIAMETER_DOUBTED else None


def warnings(observations: Observations, adjustment: Adjustment) -> list[str]:
    """Warnings about a calibration, each with a cause."""
    found = []
    if len(observations.poses) < FEW_POSES:
        found.append(f"only {len(observations.poses)} poses: {FEW_POSES} to 40 are usual")
    if not adjustment.converged:
        found.append("the adjustment ended before it converged: the poses hardly determine the lenses; more of them, tilted more")
    found += _contradictions(observations, adjustment)
    uncertainty = adjustment.calibration.uncertainty
    for number, device in enumerate(observations.devices):
        camera = adjustment.calibration.cameras[device]
        if not is_one_to_one(camera, margin=0):
            found.append(
                f"{device}: the lens model folds within the image, where pixels have no ray: more points there, or another model"
            )
        elif device in adjustment.problem.tightness:
            found.append(f"{device}: the points leave a pole or a fold near the image; the lens is held to weaker distortion")
        elif not is_one_to_one(camera):
            found.append(
                f"{device}: the lens model folds just outside the image, as the points ask for it: don't trust its corners"
            )
        seen = observations.pixels[:, :, number].reshape(-1, 2)
        part = measuring_part(adjustment, device)
        if (share := coverage(seen, part)) < COVERED:
            found.append(
                f"{device}: points surround {100 * share:.0f} % of the image; "
                f"none {_where(seen, part)}, where distortion is a guess"
            )
        spread = uncertainty.sigma(f"{device}.fx") / camera.matrix[0, 0] if uncertainty else 0.0
        apart = lengths.shift(camera.camera_from_world[:3, 3])
        if units := lengths.DEVICES_APART.units(apart):
            found.append(f"{device}: is {apart:.4g} mm from {WORLD}: was the board's spacing given in {units}?")
        if device != PROJECTOR and (np.diag(camera.camera_from_world)[:2] < UPSIDE_DOWN).all():
            found.append(
                f"{device}: stands upside down beside {WORLD}: is it mounted so, or are its images turned by 180 degrees?"
            )
        if stretched := stretch(device, camera, spread):
            found.append(stretched)
        if spread > UNSURE_FOCAL:
            found.append(f"{device}: focal length is known to {100 * spread:.2g} % only: more poses, tilted more")
    return found


def stretch(device: str, camera: Camera, sigma: float) -> str | None:
    """A warning of focal lengths that differ by more than those of square pixels, and than their relative standard deviation."""
    aspect = float(camera.matrix[0, 0] / camera.matrix[1, 1])
    if abs(aspect - 1) <= max(STRETCHED, SURE * sigma):
        return None
    return (
        f"{device}: focal lengths fx / fy are {aspect:.2f}, expected 1: does the display scale the patterns to another "
        "resolution, or aren't its pixels square (diamond pixels of a DLP)?"
    )


def _contradictions(observations: Observations, adjustment: Adjustment) -> list[str]:
    """Warnings of residuals beyond what detection predicts; of two cameras, that they may have exposed at different moments."""
    found, cameras = [], [device for device in observations.devices if device != PROJECTOR]
    for device in observations.devices:
        if (factor := adjustment.noise[device]) > NOISY:
            causes = "board not flat or not to measure, moved between images, or a lens that the model doesn't describe"
            if device in cameras and len(cameras) > 1:
                causes = f"did both cameras expose at the same moment? devices=[{cameras[0]}] shows one alone; or {causes}"
            found.append(f"{device}: residuals are {factor:.1f} times what detection predicts: {causes}")
    return found


def measuring_part(adjustment: Adjustment, device: str) -> Array:
    """Corners : (m, 2) px of the part of a device's image that measures.

    Of a camera all of it; of a projector what camera 1 sees of it, from where the board was nearest to where it was farthest, or
    all of it where one of the lens models folds before camera 1's corners.
    """
    cameras = adjustment.calibration.cameras
    corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    if device != PROJECTOR or len(cameras) == 1:
        return corners * cameras[device].size
    first = next(iter(cameras.values()))
    depths = np.concatenate([rigid.apply(pose, adjustment.points)[:, 2] for pose in adjustment.poses])
    rays = first.rays(corners * (np.array(first.size) - 1.0))
    if not np.isfinite(rays).all():
        return corners * cameras[device].size
    world = np.concatenate([rays / rays[:, 2:] * depth for depth in (depths.min(), depths.max())])
    reached = cameras[device].project(world)
    return np.clip(reached, 0, cameras[device].size) if np.isfinite(reached).all() else corners * cameras[device].size


def coverage(pixels: Array, part: Array) -> float:
    """Area of the convex hull of points : (m, 2) px over that of a part of the image, by its corners : (k, 2) px; at most 1."""
    known = pixels[np.isfinite(pixels).all(axis=1)]
    whole = ConvexHull(part).volume
    try:
        return min(float(ConvexHull(known).volume / whole), 1.0)
    except (QhullError, ValueError):  # of fewer than three points, or of some on one line
        return 0.0


def _where(pixels: Array, part: Array) -> str:
    """The sides of a part of the image, by its corners : (k, 2) px, that no point : (m, 2) px is near, in words."""
    known, size = pixels[np.isfinite(pixels).all(axis=1)], np.ptp(part, axis=0)
    left, top = (known.min(axis=0) - part.min(axis=0)) / size
    right, bottom = (part.max(axis=0) - known.max(axis=0)) / size
    sides = {"at the top": top, "at the bottom": bottom, "at the left": left, "at the right": right}
    return " and ".join(name for name, gap in sides.items() if gap > FAR_OFF) or "in some corners"
