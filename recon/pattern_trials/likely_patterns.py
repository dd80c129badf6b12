"""Likely fringes where the given one contradicts a board's images: shifts backwards, another origin or first shift.

A board is flat, so its points lie in the projector's image as a homography maps them from the board, but for the lens. Fringe
orders that are wrong by one in a part of each period throw them off by a share of the pitch.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from recon.capture.board_part import FRINGE_CAMERA, BoardCapture, Pose
from recon.model.patterns import Fringes, Patterns
from recon.optical_calibration.observations import PROJECTOR
from recon.optical_calibration.sightings import sight

POSES = 3  # that are tried: each is decoded once a sequence
FITS = 0.1  # of the pitch: largest misfit of a sequence that fits; a distorting lens makes some of it
BETTER = 4.0  # times smaller than of the given sequence
ALIKE = 1.5  # times the least misfit: of such sequences those with the fewest changes are named
AND = " and "  # between fields


class Alternative(NamedTuple):
    """A sequence with other fields in its sets of fringes."""

    fields: str  # of the patterns, for messages
    patterns: Patterns


def alternatives(patterns: Patterns) -> Iterator[Alternative]:
    """Sequences for which the given one is easily mistaken."""
    for turned in (False, True):
        for half, first in ((False, 0), (True, 0), (False, 1), (False, -1)):
            if turned or half or first:
                yield _changed(patterns, turned, half, first)


def likely(captured: BoardCapture) -> str | None:
    """Fields of the patterns that fit a board's images far better than those given, or several that do alike; None if none do.

    Raises
    ------
    InputError
        If an image is damaged, or doesn't fit its device.
    """
    given = captured.patterns
    numbers = [number for number, record in enumerate(captured.records) if FRINGE_CAMERA in record.fringes]
    if given is None or not numbers or not any(isinstance(part, Fringes) for part in given.parts):
        return None
    chosen = np.unique(np.linspace(0, len(numbers) - 1, POSES).astype(int))
    poses = [captured.pose(numbers[k]) for k in chosen]
    tried = [(alternative.fields, misfit(captured, poses, alternative.patterns)) for alternative in alternatives(given)]
    least = min(found for _, found in tried)
    pitch = min(part.pitch for part in given.parts if isinstance(part, Fringes))
    if least > FITS * pitch or BETTER * least > misfit(captured, poses, given):
        return None
    fitting = [fields for fields, found in tried if found <= ALIKE * least]
    fewest = min(fields.count(AND) for fields in fitting)
    return ", or ".join(fields for fields in fitting if fields.count(AND) == fewest)


def misfit(captured: BoardCapture, poses: Sequence[Pose], patterns: Patterns) -> float:
    """Median over poses of the points' distances, in projector px, from where a homography maps them from the board."""
    return float(np.median([_of_pose(captured, pose, patterns) for pose in poses]))


def _of_pose(captured: BoardCapture, pose: Pose, patterns: Patterns) -> float:
    """RMS of one pose; infinite if its fringes can't be decoded, or show the projector's image mirrored."""
    bits = {FRINGE_CAMERA: captured.devices[FRINGE_CAMERA].bits}
    lit = {FRINGE_CAMERA: pose.lit[FRINGE_CAMERA]}
    seen = sight(pose.name, captured.board, lit, pose.fringes, patterns, bits)
    if PROJECTOR not in seen.pixels:
        return np.inf
    known = np.isfinite(seen.pixels[PROJECTOR]).all(axis=1)
    points, pixels = captured.board.points()[known, :2], seen.pixels[PROJECTOR][known]
    homography, _ = cv2.findHomography(points, pixels)
    if homography is None or np.median(np.linalg.det(seen.gradient[known])) < 0:
        return np.inf
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return float(np.sqrt(np.mean(np.sum((mapped[:, :2] / mapped[:, 2:] - pixels) ** 2, axis=1))))


def _changed(patterns: Patterns, turned: bool, half: bool, first: int) -> Alternative:
    """The sequence with shifts the other way, an origin half a pitch further, or another first shift, in each set of fringes."""
    parts = list(patterns.parts)
    values: dict[str, dict[str, str]] = {}  # field: its values, each with an axis that has it
    for number, part in enumerate(parts):
        if isinstance(part, Fringes):
            changes: dict[str, bool | float] = {"backwards": not part.backwards} if turned else {}
            changes |= {"origin": part.zero(patterns.length(part.axis)) + part.pitch / 2} if half else {}
            changes |= {"first": part.first + first} if first else {}
            parts[number] = part.model_copy(update=changes)
            for field, value in changes.items():
                values.setdefault(field, {})[str(value).lower()] = part.axis
    text = AND.join(f"{field}: {_named(axes)}" for field, axes in values.items())
    return Alternative(text, patterns.model_copy(update={"parts": tuple(parts)}))


def _named(axes: Mapping[str, str]) -> str:
    """Values of a field : value -> axis, in words; the axis goes without saying where all sets have one value."""
    return next(iter(axes)) if len(axes) == 1 else ", ".join(f"{value} of {axis}" for value, axis in axes.items())
