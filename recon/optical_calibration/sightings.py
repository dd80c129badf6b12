"""From the images of one pose of the board to where each device sees its points; from all poses to one set of observations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

from recon import arguments, linear_algebra
from recon.board_detection.detect import BoardNotFound, Detection, detect
from recon.errors import InputError
from recon.model.boards import Board
from recon.model.patterns import Patterns
from recon.optical_calibration.observations import PROJECTOR, Observations, Size
from recon.optical_calibration.projector_points import correspondences
from recon.structured_light.decode import LINEAR, Linearity, decode
from recon.structured_light.phase_bend import Bend
from recon.structured_light.plausibility import CodeOutside

Array = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]

CORNER_REACH = 0.45  # of the distance between corners: window of the fringes' local model
DISC_REACH = 1.7  # of a disc's radius
MARGIN = 24  # px around all such windows: orders are carried by 8 px at most, and edges are smoothed by 1
ENOUGH = 8  # points of a pose that a device must see, to place it
FIRST = "cam1"


class Cause(Enum):
    """Causes for which a device sees nothing of the board in a pose."""

    NO_BOARD = auto()
    UNDECODED = auto()  # the projector's patterns aren't as the manifest has them
    CODE_OUTSIDE = auto()  # the projector's code leaves its image
    FEW_POINTS = auto()


@dataclass(frozen=True)
class Failure:
    """A device's sighting that came to nothing."""

    cause: Cause
    reason: str  # in words

    def __str__(self) -> str:
        return self.reason


@dataclass(frozen=True)
class Sighting:
    """Sighting of one pose by all devices; a device without any point has no entry."""

    name: str
    pixels: Mapping[str, Array]  # device: (n, 2) px, NaN where a point isn't seen
    covariance: Mapping[str, Array]  # device: (n, 2, 2) px^2
    gradient: Array  # (n, 2, 2) projector px / cam1 px
    radii: Mapping[str, Array] = field(default_factory=dict)  # camera: (n, 2) px, semi-axes of the discs
    failures: Mapping[str, Failure] = field(default_factory=dict)  # of devices that see nothing
    linearity: Linearity = LINEAR  # of the fringes' light


@linear_algebra.on_one_thread()
def sight(
    name: str, board: Board, lit: Mapping[str, Image], fringes: Image | None, patterns: Patterns | None, bits: Mapping[str, int]
) -> Sighting:
    """Find the board in the images of one pose.

    Parameters
    ----------
    lit : camera -> (h, w)
        The board under even light: the projector fully on, or the mean of the patterns.
    fringes : (n, h, w), optional
        Camera 1's images of a pattern sequence with fringes or Gray code along both axes.
    patterns : Patterns, optional
        That sequence.
    bits : camera -> int
        Full scale of its images is `2**bits - 1`.

    Returns
    -------
    Sighting
        A camera that doesn't find the board is left out, with the reason; so is the projector if its fringes can't be decoded.

    Raises
    ------
    InputError
        If an image is none of grey levels of its camera's bits, or there are fringes without patterns, or other ones.
    """
    _check(name, board, lit, fringes, patterns, bits)
    found: dict[str, Detection] = {}
    failures: dict[str, Failure] = {}
    for camera, image in lit.items():
        try:
            found[camera] = detect(image, board, full=2.0 ** bits[camera] - 1)
        except BoardNotFound as reason:
            failures[camera] = Failure(Cause.NO_BOARD, str(reason))
    pixels = {camera: detection.pixels for camera, detection in found.items()}
    covariance = {camera: detection.covariance for camera, detection in found.items()}
    radii = {camera: detection.radii for camera, detection in found.items() if detection.radii is not None}
    sighting = Sighting(name, pixels, covariance, np.zeros((len(board.points()), 2, 2)), radii, failures)
    if fringes is None or patterns is None or FIRST not in lit:
        return without_scraps(sighting)
    return with_projector(sighting, board, lit[FIRST], fringes, patterns, bits[FIRST])


def _check(
    name: str, board: Board, lit: Mapping[str, Image], fringes: Image | None, patterns: Patterns | None, bits: Mapping[str, int]
) -> None:
    """Refuse what `sight` can't take."""
    place = f"find_board: {name}"
    arguments.of_kind(f"{place}: board", board, Board)
    for argument, value in (("lit", lit), ("bits", bits)):
        arguments.of_kind(f"{place}: {argument}", value, Mapping, way="one entry a camera: {'cam1': ...}")
    arguments.of_kind(f"{place}: patterns", patterns, Patterns, type(None), way="sonotwin.read_patterns reads them")
    if lacking := [camera for camera in lit if camera not in bits]:
        raise InputError(f"{place}: bits: expected those of {', '.join(lacking)}, found {', '.join(bits) or 'none'}")
    for camera, image in lit.items():
        arguments.grey_levels(f"{place}: lit: {camera}", image, ("h", "w"), bits[camera])
    if fringes is not None and FIRST in lit:
        shape = ("n" if patterns is None else patterns.count, *np.shape(lit[FIRST]))
        arguments.grey_levels(f"{place}: fringes", fringes, shape, bits[FIRST])


def with_projector(sighting: Sighting, board: Board, lit: Image, fringes: Image, patterns: Patterns, bits: int) -> Sighting:
    """The sighting with the projector's of the points that camera 1 sees, or the reason why its fringes can't be decoded.

    lit, fringes : (h, w) and (n, h, w) of camera 1; see `sight`
    """
    if FIRST not in sighting.pixels:
        return without_scraps(sighting)
    try:
        centres, reach = sighting.pixels[FIRST], _reach(sighting, board)
        rows, columns = _around(centres, reach, patterns, lit.shape)
        projector_map = decode(fringes[:, rows, columns], patterns, bits=bits, name=f"{sighting.name}: fringes")
        corner = np.array([columns.start, rows.start])
        seen = correspondences(projector_map, lit[rows, columns], centres - corner, reach)
    except InputError as reason:
        cause = Cause.CODE_OUTSIDE if isinstance(reason, CodeOutside) else Cause.UNDECODED
        return without_scraps(replace(sighting, failures={**sighting.failures, PROJECTOR: Failure(cause, str(reason))}))
    pixels, covariance = (
        {**own, PROJECTOR: its} for own, its in ((sighting.pixels, seen.pixels), (sighting.covariance, seen.covariance))
    )
    seen_as = {"gradient": seen.gradient, "linearity": projector_map.linearity}
    return without_scraps(replace(sighting, pixels=pixels, covariance=covariance, **seen_as))


def without_scraps(sighting: Sighting) -> Sighting:
    """The sighting without devices that have too few points for the pose; they get a reason instead."""
    counts = {device: int(np.isfinite(pixels).all(axis=1).sum()) for device, pixels in sighting.pixels.items()}
    scraps = {device: count for device, count in counts.items() if count < ENOUGH}
    reasons = {
        device: Failure(Cause.FEW_POINTS, f"only {count} of {len(sighting.pixels[device])} points, {ENOUGH} are needed")
        for device, count in scraps.items()
    }

    def kept(values: Mapping[str, Array]) -> dict[str, Array]:
        return {device: value for device, value in values.items() if device not in scraps}

    pixels, covariance, radii = kept(sighting.pixels), kept(sighting.covariance), kept(sighting.radii)
    return replace(sighting, pixels=pixels, covariance=covariance, radii=radii, failures={**sighting.failures, **reasons})


def light(sightings: Sequence[Sighting]) -> Linearity:
    """The fringes' light in all poses: of each kind of fringes the largest bend, or the reason why some pose doesn't show it."""
    seen = [sighting.linearity for sighting in sightings]
    bends: dict[tuple[int, float], Bend] = {}
    for bend in (bend for one in seen for bend in one.bends):
        kind = bend.steps, bend.pitch
        bends[kind] = max(bends.get(kind, bend), bend, key=lambda each: each.most_px)
    unknown = {(part.steps, part.pitch): (part, why) for one in seen for part, why in one.unknown}
    return Linearity(tuple(bends.values()), tuple(unknown.values()), max((one.clipped for one in seen), default=0.0))


def gather(sightings: Sequence[Sighting], board: Board, sizes: Mapping[str, Size]) -> Observations:
    """Lay the sightings of all poses side by side, those of poses that no device sees left out.

    sizes : device -> (width, height) px, in the order in which devices are to stand: camera 1 first.
    """
    used = [sighting for sighting in sightings if sighting.pixels]
    devices = [device for device in sizes if any(device in sighting.pixels for sighting in used)]
    count = len(board.points())
    nowhere, unknown = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
    pixels = [[sighting.pixels.get(device, nowhere) for device in devices] for sighting in used]
    covariance = [[sighting.covariance.get(device, unknown) for device in devices] for sighting in used]
    return Observations(
        tuple(sighting.name for sighting in used),
        tuple(devices),
        tuple(sizes[device] for device in devices),
        board.points(),
        np.array(pixels).swapaxes(1, 2),
        np.array(covariance).swapaxes(1, 2),
        np.nan_to_num(np.array([sighting.gradient for sighting in used])),
    )


def _around(centres: Array, reach: Array, patterns: Patterns, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of the part of an image that holds the windows about all points, with a margin.

    It is the whole where orders need it, as by a centre line, which may lie beside the board.
    """
    if patterns.unwrapping.WHOLE_IMAGE:
        return slice(0, shape[0]), slice(0, shape[1])
    known = np.isfinite(centres).all(axis=1) & np.isfinite(reach)
    if not known.any():
        raise InputError("expected points in more than one row, found none whose distance to its neighbours is known")
    low = np.floor((centres[known] - reach[known, None]).min(axis=0)).astype(int) - MARGIN
    high = np.ceil((centres[known] + reach[known, None]).max(axis=0)).astype(int) + MARGIN + 1
    (left, top), (right, bottom) = np.maximum(low, 0).tolist(), np.minimum(high, shape[::-1]).tolist()
    return slice(top, bottom), slice(left, right)


def _reach(sighting: Sighting, board: Board) -> Array:
    """Radius of the window : (n,) px of camera 1, in which the fringes around each point are looked at."""
    if FIRST in sighting.radii:
        return np.nan_to_num(DISC_REACH * sighting.radii[FIRST].max(axis=1), nan=1.0)
    points, pixels = board.points()[:, :2], sighting.pixels[FIRST]
    known = np.isfinite(pixels[:, 0])
    magnified = np.sqrt(np.linalg.det(np.cov(pixels[known].T)) / np.linalg.det(np.cov(points[known].T)))  # (px / mm)^2
    step = np.linalg.norm(points[1] - points[0])
    return np.full(len(pixels), CORNER_REACH * step * np.sqrt(magnified))
