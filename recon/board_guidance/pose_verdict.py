"""Whether a pose of the board is worth keeping, and if not, the reason and the way on.

`judge_lit` says what can be said by the cameras' images alone, before a projector's sequence is taken; `judge` says all.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.board_guidance.board_room import ALIKE_DEG, ALIKE_MM, Reach, apart, candidates, reach_of
from recon.board_guidance.next_pose import CANDIDATES, few, knowledge
from recon.board_guidance.pose_progress import BAD_POSE, SoFar, held, with_sighting
from recon.geometry.camera import Array
from recon.optical_calibration.observations import PROJECTOR
from recon.optical_calibration.sightings import Sighting

STEEPEST = 0.998  # quantile of the slopes: discs of 20 px radius have 1 % of all pixels on edges of one direction


@dataclass(frozen=True)
class Observation:
    """All that was seen of the board in one pose."""

    sighting: Sighting
    lit: Mapping[str, NDArray] = field(default_factory=dict)  # camera: (h, w), the images that it was found in
    again: Mapping[str, Array] = field(default_factory=dict)  # camera: (n, 2) px, once more after the last frame; NaN: not found
    asked_gain: float | None = None  # of the pose that was asked for; that of the best of many if none was


@dataclass(frozen=True)
class Verdict:
    """A verdict on one pose."""

    accepted: bool
    reason: str  # of a refusal, with the way on; else what it adds
    gain: float  # relative reduction of the points' standard deviations by the pose; 0 if it has no place
    so_far: SoFar  # with the pose, if it was accepted


def judge(observation: Observation, so_far: SoFar, reach: Reach | None = None) -> Verdict:
    """Judge a pose: all devices must see the board, sharp and at rest, in agreement with the poses so far, and add to these.

    Whoever wants to keep a pose that was refused takes `pose_progress.with_sighting` instead.

    reach : the limits, of which the volume counts here; those of the rig's lenses if not given.
    """
    faults = chain(_camera_faults(observation, so_far), _later_faults(observation, so_far))
    verdict = _by_faults_and_gain(observation, so_far, reach, faults)
    if not verdict.accepted:
        return verdict
    extended = with_sighting(so_far, observation.sighting)
    if disagreeing := _disagreement(so_far, extended):
        return Verdict(False, disagreeing, verdict.gain, so_far)
    return replace(verdict, so_far=extended)


def judge_lit(observation: Observation, so_far: SoFar, reach: Reach | None = None) -> Verdict:
    """Judge a pose by the cameras' images alone: all cameras must see the board, sharp, and it must add to the poses so far.

    The projector counts as one that will see what lies in its light. A pose that is accepted isn't part of `so_far` yet.
    """
    return _by_faults_and_gain(observation, so_far, reach, _camera_faults(observation, so_far))


def _by_faults_and_gain(observation: Observation, so_far: SoFar, reach: Reach | None, faults: Iterator[str]) -> Verdict:
    """Refuse a pose by the gravest fault, or if it adds little; one that is accepted isn't part of `so_far` yet."""
    pose, fault = held(observation.sighting, so_far), next(faults, None)
    if pose is None:
        return Verdict(False, fault or "cam1: the board has no place; show all of it to camera 1", 0.0, so_far)
    reach = reach or reach_of(so_far.rig)
    gain = _gains(pose[None], so_far, reach)[0]
    if refusal := fault or _too_alike(pose, so_far, gain, observation.asked_gain, reach):
        return Verdict(False, refusal, gain, so_far)
    return Verdict(True, f"adds {100 * gain:.1f} %", gain, so_far)


def _camera_faults(observation: Observation, so_far: SoFar) -> Iterator[str]:
    """What is wrong with the cameras' images, the gravest first."""
    sighting = observation.sighting
    yield from (_not_found(device, sighting) for device in so_far.sizes if device != PROJECTOR and device not in sighting.pixels)
    blurred_px = 3.0  # standard deviation, in the softest direction
    smeared = 2.0, 0.5  # softest over sharpest direction, and px on top: beyond, the board moved while the camera exposed
    for device, image in observation.lit.items():
        found = board_blur(image, sighting.pixels[device])
        if found.most > smeared[0] * found.least + smeared[1]:
            yield f"{device}: smeared by {found.most:.1f} px: the board moved during the exposure; rest it, or expose shorter"
        elif found.most > blurred_px:
            yield f"{device}: blurred by {found.most:.1f} px: out of focus; hold it nearer to the middle distance, or focus"


def _later_faults(observation: Observation, so_far: SoFar) -> Iterator[str]:
    """What went wrong from the first frame to the last, the gravest first."""
    sighting = observation.sighting
    if PROJECTOR in so_far.sizes and PROJECTOR not in sighting.pixels:
        yield _not_found(PROJECTOR, sighting)
    moved_px = 0.1  # median of the points, from the first frame to the last: twenty times the noise of a disc's centre
    for device, pixels in observation.again.items():
        away = np.linalg.norm(pixels - sighting.pixels[device], axis=1)
        if np.isnan(away).all():
            yield f"{device}: the board was out of sight after the last frame; rest it on something, until all is taken"
        elif (moved := float(np.nanmedian(away))) > moved_px:
            yield f"{device}: the board moved by {moved:.2f} px between the first frame and the last; rest it on something"


def _not_found(device: str, sighting: Sighting) -> str:
    reason = sighting.failures.get(device)
    way = f"hold it so that {device} sees all of it, evenly lit"
    if device == PROJECTOR:
        way = "hold it so that all of it lies in the projector's light, and nothing shades it"
    return f"{device}: board not found{f': {reason}' if reason else ''}; {way}"


def _gains(poses: Array, so_far: SoFar, reach: Reach) -> list[float]:
    """Relative reductions of the points' standard deviations by each of poses : (p, 4, 4)."""
    known = knowledge(so_far.calibration, so_far.poses, so_far.rig, so_far.board, reach, so_far.noise)
    return known.gains(poses, few(so_far.board.points())).tolist()


def _too_alike(pose: Array, so_far: SoFar, gain: float, asked: float | None, reach: Reach) -> str | None:
    """Refusal of a pose that adds little, or that stands where an earlier one stood."""
    if len(so_far.poses) == 0:
        return None
    apart_mm, apart_deg = (each[:, 0] for each in apart(so_far.poses, pose[None], so_far.board))
    nearest = int(np.argmin(apart_mm / ALIKE_MM + apart_deg / ALIKE_DEG))
    best = _best_gain(so_far, reach) if asked is None else asked
    adds = f"adds {100 * gain:.1f} % where {100 * best:.1f} % is possible"
    if apart_mm[nearest] < ALIKE_MM and apart_deg[nearest] < ALIKE_DEG:
        away = f"{apart_mm[nearest]:.0f} mm and {apart_deg[nearest]:.0f} deg from it"
        return f"too like pose {so_far.sightings[nearest].name}, {away}: {adds}; hold it as shown"
    least_share = 0.7  # of what the asked pose would add; an earlier pose once more adds half of it, by averaging noise
    return None if gain >= least_share * best else f"{adds}; hold it as shown"


def _best_gain(so_far: SoFar, reach: Reach) -> float:
    """Gain of the best of many poses; the same for the same sightings."""
    choice = candidates(so_far.board, so_far.cameras, reach, CANDIDATES, np.random.default_rng(len(so_far.poses)))
    return max(_gains(choice, so_far, reach))


def _disagreement(so_far: SoFar, extended: SoFar) -> str | None:
    """Whether the latest pose contradicts the others: by its own residuals, or those of all, as few poses bend towards it."""
    if so_far.calibration is None or extended.calibration is None:
        return None
    spread = [extended.noise[device] / so_far.noise[device] for device in so_far.sizes]
    times = np.maximum(extended.misfit[-1], spread)
    if times.max() < BAD_POSE:
        return None
    device = list(so_far.sizes)[int(np.argmax(times))]
    return f"{device}: contradicts the other poses by {times.max():.0f} times the noise: the board moved between frames; rest it"


class Blur(NamedTuple):
    """Standard deviations of the blur, px."""

    least: float  # in the sharpest direction
    most: float  # in the softest


def board_blur(image: NDArray, pixels: Array) -> Blur:
    """Blur of the image : (h, w) of a board whose points lie at pixels : (n, 2), NaN where not seen.

    An edge of contrast C that is blurred by s has the steepest slope `C / (sqrt(2 pi) s)` across it.
    """
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    around = 0.1  # of the points' extent, beyond them
    beyond = around * np.ptp(seen, axis=0)
    left, top = np.maximum(seen.min(axis=0) - beyond, 0).astype(int)
    right, low = (seen.max(axis=0) + beyond + 2).astype(int)
    smoothing = 1.0  # px, standard deviation: taken out of the blur again
    level = cv2.GaussianBlur(np.float32(image[top:low, left:right]), (0, 0), smoothing)
    across, down = (cv2.Sobel(level, cv2.CV_32F, du, dv, ksize=1, scale=0.5) for du, dv in ((1, 0), (0, 1)))
    dark, bright = 0.05, 0.95  # quantiles of the levels, both of which a board has many of
    contrast = float(np.subtract(*np.quantile(level, [bright, dark])))
    widths = []
    directions = 4  # over half a turn
    for way in np.pi / directions * np.arange(directions):
        steepest = float(np.quantile(np.abs(np.cos(way) * across + np.sin(way) * down), STEEPEST))
        width = contrast / (np.sqrt(2 * np.pi) * max(steepest, 1e-9))
        widths.append(np.sqrt(max(width**2 - smoothing**2, 0.0)))
    return Blur(min(widths), max(widths))
