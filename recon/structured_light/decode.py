"""From the images of a pattern sequence to projector coordinates, with their predicted noise."""

from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon import arguments
from recon.compiled import kernel
from recon.errors import InputError
from recon.model.patterns import AnyPart, Axis, Fringes, GrayCode, Patterns, Uniform
from recon.structured_light import frame_errors, gray_cells, plausibility, straightening
from recon.structured_light.gray_code import Orders
from recon.structured_light.phase import DEFAULT_NOISE, FrameErrors, Fringe, Noise, estimate_noise, wrapped_phase
from recon.structured_light.phase_bend import Bend, Hidden
from recon.structured_light.shots import Mask, Shots, finest
from recon.threads import in_threads

Image = NDArray[np.float32]
NoiseSource = Literal["given", "measured", "assumed"]

DARKEST = 4.0  # DN of 255: default of the least modulation
SMALLEST = 8  # px, an image's shorter side: the extent of the stencil of continuity
WORST_SIGMA = 0.3  # rad of predicted phase noise: beyond, orders can't be decided
NOISIER = "are dark pixels noisier than assumed (a camera with a gamma)"  # where noise is assumed
LIT_SIGMA = 0.25  # rad: fringes that strong come about by noise in one pixel of 3000


class Status(IntEnum):
    """The outcome of decoding a pixel."""

    OK = 0
    DARK = 1  # too little modulation
    SATURATED = 2  # at full scale in a fringe image
    UNREACHABLE = 3  # a surface without the centre line
    UNCERTAIN = 4  # an ambiguous order: a tear, a border, contradicting bits or pitches
    OUTSIDE = 5  # decoded to a coordinate beyond the projector's image


# Numba takes no enumeration members as constants.
OK, DARK, SATURATED, UNREACHABLE, UNCERTAIN, OUTSIDE = map(int, Status)


class Scale(NamedTuple):
    """Projector px of an axis: `x = origin + pitch * cycles`, in [-0.5, length - 0.5]."""

    origin: float
    pitch: float
    length: int


class Coordinates(NamedTuple):
    """Projector coordinates along an axis. All (h, w)."""

    x: Image  # projector px, NaN where unknown
    sigma: Image  # projector px
    status: NDArray[np.uint8]  # Status


class Linearity(NamedTuple):
    """Bends of phases by light that isn't linear, which fringes of three or four steps show."""

    bends: tuple[Bend, ...] = ()  # measured and undone
    unknown: tuple[tuple[Fringes, Hidden], ...] = ()  # fringes that don't show theirs, and why
    clipped: float = 0.0  # share of black samples in strong fringes; see `plausibility.clipped`


LINEAR = Linearity()


class _AxisMap(NamedTuple):
    """What the images of an axis show. Images are (h, w)."""

    coordinates: Coordinates
    modulation: Image  # DN
    offset: Image  # DN
    phase: Image  # rad, NaN without fringes
    lit: Mask
    counts: dict[str, int]  # for the summary
    linearity: Linearity = LINEAR


@dataclass(frozen=True)
class ProjectorMap:
    """Projector coordinates of a camera's pixels. All images (h, w)."""

    columns: Image | None  # projector px, NaN where unknown; None if not encoded
    rows: Image | None
    sigma_columns: Image | None  # projector px, predicted standard deviation, NaN where unknown
    sigma_rows: Image | None
    modulation: Image  # DN, of the first axis
    offset: Image  # DN
    phase: Image  # rad, wrapped, of the first axis; NaN where that has no fringes
    status: NDArray[np.uint8]  # Status; OK where every encoded axis is
    lit: Mask  # with fringes in every set, be they too weak to be decoded
    noise: Noise  # of one image
    summary: dict[str, int]  # pixels by status in lower case; regions, islands, disputed with a centre line
    noise_source: NoiseSource = "given"  # by the caller, measured on the fringes, or assumed, as they are too few to measure it
    linearity: Linearity = LINEAR
    camera: str = ""  # that took the images, by its name in the calibration; empty where it isn't known
    projector_size: tuple[int, int] | None = None  # width, height of the patterns, px


def decode(
    images: NDArray,
    patterns: Patterns,
    *,
    bits: int = 8,
    noise: Noise | None = None,
    min_modulation_dn: float | None = None,
    name: str = "images",
    camera: str = "",
) -> ProjectorMap:
    """Decode a camera's images of a pattern sequence.

    The projector coordinate is `x = origin + pitch * (phase / 2 pi + k)`, its noise `pitch / (2 pi) * sigma_phase`. Of Gray code
    without fringes it is the middle of a cell; see `gray_cells`.

    Parameters
    ----------
    images : (n, h, w) uint8 or uint16, DN
        One an image of the sequence, in its order.
    patterns : Patterns
        The sequence.
    bits : int
        Full scale is `2**bits - 1`.
    noise : Noise, optional
        Of one image. If not given it is measured from fringes of eight or more steps; with fewer steps a default stands in;
        the map's `noise_source` says which.
    min_modulation_dn : float, optional
        Least modulation, below which a pixel is dark; 4 DN of 255 if not given.
    name : str
        Of the images, for messages, such as `surface/cam1`.
    camera : str
        That took the images, by its name in the calibration, such as `cam1`: the map then fits no other.

    Raises
    ------
    InputError
        If the number or the size of the images is wrong, they are black or saturated, or they do not follow the sequence.
    """
    arguments.of_kind(f"{name}: patterns", patterns, Patterns, way="sonotwin.read_patterns reads them by name or file")
    arguments.of_kind(f"{name}: noise", noise, Noise, type(None))
    images = arguments.grey_levels(name, images, (patterns.count, "h", "w"), bits)
    if min(images.shape[1:]) < SMALLEST:
        found = f"{images.shape[2]}x{images.shape[1]}"
        raise InputError(f"{name}: expected images of {SMALLEST}x{SMALLEST} px or more, found {found}")
    full = 2.0**bits - 1
    least = DARKEST * full / 255
    if min_modulation_dn is not None:
        least = arguments.number(f"{name}: min_modulation_dn", min_modulation_dn, most=full)
    parts = patterns.slices()
    errors = {
        place.start: frame_errors.estimate(images[place], part.shifts, least_modulation=least, saturation=full)
        for part, place in parts
        if isinstance(part, Fringes)
    }
    noise, source = _noise(images, parts, errors, full, noise)
    shots = Shots(images, patterns, errors, noise, least, full, name, NOISIER if source == "assumed" else "")
    axes: dict[Axis, _AxisMap] = {
        axis: (_from_fringes if patterns.has_fringes(axis) else _from_code)(shots, axis) for axis in patterns.axes
    }
    first, *others = (axes[axis] for axis in patterns.axes)
    status, lit, counts, linearity = first.coordinates.status, first.lit, Counter(first.counts), first.linearity
    for found in others:
        counts.update(found.counts)
        its = found.linearity
        linearity = Linearity(linearity.bends + its.bends, linearity.unknown + its.unknown, max(linearity.clipped, its.clipped))
        lit = lit & found.lit
        status = np.where(status == Status.OK, found.coordinates.status, status)
    columns, rows = (axes[axis].coordinates[:2] if axis in axes else (None, None) for axis in ("columns", "rows"))
    pixels = cv2.calcHist([status], [0], None, [len(Status)], [0, len(Status)]).astype(int).ravel().tolist()
    summary = {s.name.lower(): pixels[s] for s in Status} | dict(counts)
    return ProjectorMap(
        columns=columns[0],
        rows=rows[0],
        sigma_columns=columns[1],
        sigma_rows=rows[1],
        modulation=first.modulation,
        offset=first.offset,
        phase=first.phase,
        status=status,
        lit=lit,
        noise=noise,
        summary=summary,
        noise_source=source,
        linearity=linearity,
        camera=camera,
        projector_size=patterns.projector_size,
    )


def _from_fringes(shots: Shots, axis: Axis) -> _AxisMap:
    """Coordinates along an axis by the phase of its finest fringes and their orders."""
    sets, clipped = [], 0.0
    for part, place in shots.patterns.slices():
        if isinstance(part, Fringes) and part.axis == axis:
            images, frames = shots.images[place], shots.errors[place.start]
            fringe = wrapped_phase(images, part.shifts, noise=shots.noise, saturation=shots.full, errors=frames)
            plausibility.check_fringes(images, part, fringe, shots.least, shots.full, shots.where(place), place.start)
            sets.append((part, fringe))
            clipped = max(clipped, plausibility.clipped(images, shots.full))
    status, lit = _quality([f for _, f in sets], shots.least)
    length = shots.patterns.length(axis)
    sets, bends, unknown = straightening.straighten(sets, status == Status.OK, length)
    linearity = Linearity(bends, unknown, clipped)
    plausibility.check_bends(bends, clipped, f"{shots.name}: fringes of {axis}")
    part, fringe = finest(sets)
    light = plausibility.suspected(bends, unknown, clipped)
    orders, unreachable, counts = shots.patterns.unwrapping.orders(shots, axis, sets, status == Status.OK, light)
    scale = Scale(float(part.zero(length)), part.pitch, length)
    x, sigma = _coordinates(fringe, orders, unreachable, status, scale)
    return _AxisMap(
        coordinates=Coordinates(x, sigma, status),
        modulation=fringe.modulation,
        offset=fringe.offset,
        phase=fringe.phase,
        lit=lit,
        counts=counts,
        linearity=linearity,
    )


def _from_code(shots: Shots, axis: Axis) -> _AxisMap:
    """Coordinates along an axis by Gray code alone."""
    patterns, noise = shots.patterns, shots.noise
    ((code, place),) = [(p, place) for p, place in patterns.slices() if isinstance(p, GrayCode) and p.axis == axis]
    uniform = [place.start for part, place in patterns.slices() if isinstance(part, Uniform) and part.level in (0, 1)]
    black, white = levels = gray_cells.levels(shots.images[place], code, shots.images[uniform])
    modulation, offset = (white - black) / 2, (white + black) / 2
    plausibility.check_levels(modulation, offset, shots.least, shots.full, shots.where(place))
    length = patterns.length(axis)
    cells = gray_cells.locate(shots.images[place], code, levels, length, noise)
    dark = modulation < shots.least
    plausibility.check_cells(np.where(dark, gray_cells.UNKNOWN, cells.number), code, shots.where(place), place.start)
    plausibility.check_readings(cells.middle, ~dark, length, shots.where(place))
    status = np.where(np.isfinite(cells.middle), np.uint8(OK), np.uint8(UNCERTAIN))
    status[(cells.middle < -0.5) | (cells.middle > length - 0.5)] = OUTSIDE
    status[dark] = np.where(white >= shots.full, np.uint8(Status.SATURATED), np.uint8(Status.DARK))[dark]
    unknown, nothing = status != OK, np.float32(np.nan)
    x, sigma = np.where(unknown, nothing, cells.middle), np.where(unknown, nothing, cells.sigma)
    lit = modulation * LIT_SIGMA > np.sqrt(noise.read_variance + noise.gain * offset)
    phase = np.full_like(x, nothing)
    coordinates = Coordinates(x, sigma, status)
    return _AxisMap(coordinates=coordinates, modulation=modulation, offset=offset, phase=phase, lit=lit, counts={})


def _noise(
    images: NDArray, parts: list[tuple[AnyPart, slice]], errors: dict[int, FrameErrors], full: float, given: Noise | None
) -> tuple[Noise, NoiseSource]:
    """The noise given, else measured on the first fringes that allow it, else a common camera's."""
    if given is not None:
        return given, "given"
    for part, place in parts:
        if isinstance(part, Fringes):
            found = estimate_noise(images[place], part.shifts, saturation=full, errors=errors[place.start])
            if found is not None:
                return found, "measured"
    return DEFAULT_NOISE.scaled(full / 255), "assumed"


def _quality(fringes: list[Fringe], least: float) -> tuple[NDArray[np.uint8], Mask]:
    """OK, DARK or SATURATED : (h, w), the worst over the sets of fringes, and where all sets have fringes, however weak."""
    shape = fringes[0].phase.shape
    status, lit = np.zeros(shape, np.uint8), np.ones(shape, bool)
    for fringe in fringes:
        in_threads(_judge, shape[0], fringe, np.float32(least), status, lit)
    return status, lit


@kernel
def _judge(first, end, fringe: Fringe, least, status, lit):
    """Count one set of fringes to the worst of rows `first` to `end`, not included: `Status` rises from OK to SATURATED."""
    modulation, sigma, saturated = fringe.modulation, fringe.sigma, fringe.saturated
    for v in range(first, end):
        for u in range(status.shape[1]):
            dark = modulation[v, u] < least or sigma[v, u] > WORST_SIGMA
            status[v, u] = max(status[v, u], SATURATED if saturated[v, u] else DARK if dark else OK)
            lit[v, u] &= sigma[v, u] < LIT_SIGMA


def _coordinates(
    fringe: Fringe, orders: Orders, unreachable: Mask, status: NDArray[np.uint8], scale: Scale
) -> tuple[Image, Image]:
    """Projector coordinates and their noise, NaN where unknown; writes the reasons into `status`."""
    shape = status.shape
    found = Coordinates(np.empty(shape, np.float32), np.empty(shape, np.float32), status)
    in_threads(_place, shape[0], fringe.phase, fringe.sigma, orders, unreachable, scale, found)
    return found.x, found.sigma


@kernel
def _place(first, end, phase, sigma, orders: Orders, unreachable, scale: Scale, found: Coordinates):
    """Fill rows `first` to `end`, not included."""
    order, trusted, pitch, status = orders.order, orders.trusted, scale.pitch, found.status
    for v in range(first, end):
        for u in range(phase.shape[1]):
            found.x[v, u] = found.sigma[v, u] = np.nan
            if status[v, u] != OK:
                continue
            if not trusted[v, u]:
                status[v, u] = UNREACHABLE if unreachable[v, u] else UNCERTAIN
                continue
            value = scale.origin + pitch * (phase[v, u] / (2 * np.pi) + order[v, u])
            if value < -0.5 or value > scale.length - 0.5:
                status[v, u] = OUTSIDE
                continue
            found.x[v, u], found.sigma[v, u] = value, pitch / (2 * np.pi) * sigma[v, u]
