"""Filaments of an ultrasound phantom in B-scans: where they are shown, and how wide their echoes are at -6 dB.

The two tests are in kind as those of IEC 61391-1: callipers between point targets, and their axial and lateral widths over depth.
The phantom's place under the probe isn't known: it is the one in the image's plane at which most filaments have an echo. A
filament is thin, so that its echo is as wide as the scanner makes it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.acceptance.certificates import FilamentCertificate, Screen
from recon.errors import InputError

Array = NDArray[np.float64]

TILTS_DEG = np.arange(-12.0, 12.5, 1.0)  # of the phantom under the probe that are tried
HALF_DB = 20 * np.log10(2)  # from the top of an echo, at half its amplitude
LEAST_IMAGES, LEAST_FILAMENTS = 3, 3


@dataclass(frozen=True)
class Look:
    """What an echo of a filament looks like."""

    contrast_db: float = 12.0  # over the grey around it
    around_mm: float = 4.0  # size of the surroundings
    face_mm: float = 3.0  # in depth, left out: the transducer's own ringing
    most: int = 200  # echoes looked at, the brightest
    near_mm: float = 0.8  # from where the phantom has a filament, after the fit
    roughly_mm: float = 1.2  # the same before
    smooth_mm: float = 0.15  # standard deviation, before tops are looked for
    top: int = 254  # grey from which an echo is clipped
    wide_mm: float = 3.0  # widest echo
    alone_mm: float = 3.0  # from the next filament, nearer than which widths are of both


LOOK = Look()


class Echo(NamedTuple):
    """A filament in one image."""

    place: Array  # (2,) mm on the screen, along the array and in depth
    width: Array  # (2,) mm at -6 dB, along the array and in depth; NaN where the echo is clipped, or another filament is near


class Seen(NamedTuple):
    """Filaments in the images of one place."""

    numbers: tuple[int, ...]  # of the certificate, seen in all images
    places: Array  # (n, m, 2) mm on the screen, of n images and m filaments
    widths: Array  # (n, m, 2) mm


def probe_filaments(images: Sequence[NDArray[np.uint8]], certificate: FilamentCertificate, name: str, look: Look = LOOK) -> Seen:
    """Find the phantom's filaments in n B-scans (h, w), each taken with the probe lifted and placed again.

    Raises
    ------
    InputError
        If there are too few images, or too few filaments in all of them.
    """
    if len(images) < LEAST_IMAGES:
        expected = f"expected {LEAST_IMAGES} B-scans or more, each with the probe placed again"
        raise InputError(f"{name}: {expected}, found {len(images)}")
    found = [_in_image(image, certificate, look) for image in images]
    shared = sorted(set.intersection(*(set(one) for one in found)))
    if len(shared) < LEAST_FILAMENTS:
        counts = ", ".join(str(len(one)) for one in found[:6])
        expected = f"expected {LEAST_FILAMENTS} filaments or more in all B-scans, found {len(shared)} ({counts} in each)"
        raise InputError(f"{name}: {expected}: another phantom, other mm_per_px, or a gain at which they are hidden or clipped?")
    places = np.array([[one[k].place for k in shared] for one in found])
    return Seen(tuple(shared), places, np.array([[one[k].width for k in shared] for one in found]))


def _in_image(image: NDArray[np.uint8], certificate: FilamentCertificate, look: Look) -> dict[int, Echo]:
    """Filaments by their numbers."""
    screen, places = certificate.screen, np.array(certificate.places_mm)
    peaks = _peaks(image, screen, look)
    matched = _matched(peaks[:, ::-1] * screen.mm_per_px, places * [1.0, screen.assumed_m_s / certificate.speed_m_s], look)
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.diag(np.full(len(places), np.inf))
    alone = apart.min(axis=1) >= look.alone_mm
    return {number: _echo(image, screen, peaks[k], look, bool(alone[number])) for number, k in matched.items()}


def _peaks(image: NDArray[np.uint8], screen: Screen, look: Look) -> NDArray[np.int64]:
    """Rows and columns : (n, 2) of short bright echoes, the brightest first."""
    mm_per_px, db = np.array(screen.mm_per_px[::-1]), screen.dynamic_range_db / 255
    size = np.maximum(np.rint(look.around_mm / mm_per_px).astype(int), 3)
    above = db * (image.astype(float) - cv2.medianBlur(image, int(size.max()) | 1))
    smooth = ndimage.gaussian_filter(image.astype(float), look.smooth_mm / mm_per_px)
    top = smooth == ndimage.maximum_filter(smooth, size=tuple(np.maximum(size // 4, 3)))
    top[: int(np.ceil(look.face_mm / mm_per_px[0]))] = False
    rows, columns = np.nonzero(top & (above >= look.contrast_db))
    order = np.argsort(-smooth[rows, columns], kind="stable")[: look.most]
    return np.column_stack([rows, columns])[order]


def _matched(shown: Array, expected: Array, look: Look) -> dict[int, int]:
    """Echoes of filaments by number: of the pose at which most of them have one, the pose then fitted."""
    best = dict[int, int]()
    if len(shown) < LEAST_FILAMENTS:
        return best
    for tilt in np.deg2rad(TILTS_DEG):
        turned = expected @ np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]).T
        pairs = _pairs(shown, turned + _usual_shift(shown, turned, look.roughly_mm), look.roughly_mm)
        best = max(best, pairs, key=len)
    for _ in range(3):
        if len(best) < LEAST_FILAMENTS:
            return {}
        numbers = list(best)
        best = _pairs(shown, _posed(expected, expected[numbers], shown[[best[k] for k in numbers]]), look.near_mm)
    return best


def _usual_shift(shown: Array, places: Array, cell_mm: float) -> Array:
    """The shift : (2,) mm by which most places come to lie at something shown: the fullest cell with its neighbours."""
    shifts = (shown[:, None] - places[None]).reshape(-1, 2)
    cells = np.floor(shifts / cell_mm).astype(int)
    first = cells.min(axis=0) - 1
    counts = np.zeros(cells.max(axis=0) - first + 2)
    np.add.at(counts, tuple((cells - first).T), 1)
    fullest = np.unravel_index(ndimage.uniform_filter(counts, 3, mode="constant").argmax(), counts.shape)
    return np.median(shifts[(np.abs(cells - first - fullest) <= 1).all(axis=1)], axis=0)


def _posed(places: Array, own: Array, shown: Array) -> Array:
    """Places : (n, 2) by the rigid motion that takes points to where they are shown (Kabsch 1976, in the plane)."""
    middles = own.mean(axis=0), shown.mean(axis=0)
    u, _, vt = np.linalg.svd((own - middles[0]).T @ (shown - middles[1]))
    turn = (u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt).T
    return (places - middles[0]) @ turn.T + middles[1]


def _pairs(shown: Array, expected: Array, near_mm: float) -> dict[int, int]:
    """The nearest echo of each expected place, where it is near and is no other's nearest one."""
    away = np.linalg.norm(expected[:, None] - shown[None], axis=-1)
    nearest, own = away.argmin(axis=1), away.argmin(axis=0)
    return {k: int(j) for k, j in enumerate(nearest) if away[k, j] <= near_mm and own[j] == k}


def _echo(image: NDArray[np.uint8], screen: Screen, peak: NDArray[np.int64], look: Look, alone: bool) -> Echo:
    """Place and widths of the echo at a peak: by a parabola through its top, and where profiles pass half of the amplitude."""
    row, column = peak
    level = image * (screen.dynamic_range_db / 255)
    measured, tops, widths = alone and image[row, column] < look.top, list[float](), list[float]()
    for profile, at, step in zip((level[row], level[:, column]), (column, row), screen.mm_per_px, strict=True):
        tops.append((at + _top_of(profile, at)) * step)
        widths.append(_width(profile, at, step, look) if measured else np.nan)
    return Echo(np.array(tops), np.array(widths))


def _top_of(profile: Array, at: int) -> float:
    """Offset, px, of a profile's top from its highest sample."""
    if not 0 < at < len(profile) - 1:
        return 0.0
    before, here, after = profile[at - 1 : at + 2]
    bent = before - 2 * here + after
    return float(np.clip((before - after) / (2 * bent), -0.5, 0.5)) if bent < 0 else 0.0


def _width(profile: Array, at: int, step: float, look: Look) -> float:
    """Width, mm, at half of the amplitude; NaN if it is wider than an echo can be."""
    offset = _top_of(profile, at)
    top = profile[at] - offset * (profile[max(at - 1, 0)] - profile[min(at + 1, len(profile) - 1)]) / 4
    ends = []
    for side in (-1, 1):
        k = at
        while 0 <= k < len(profile) and profile[k] > top - HALF_DB:
            k += side
        if not 0 <= k < len(profile):
            return np.nan
        inner = profile[k - side]
        ends.append(k - side + side * (inner - (top - HALF_DB)) / (inner - profile[k]))
    width = (ends[1] - ends[0]) * step
    return float(width) if width <= look.wide_mm else np.nan
