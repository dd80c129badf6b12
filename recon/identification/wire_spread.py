"""The beam along the array and across the plane by echoes of wires in water, as the probe's calibration takes them.

A wire square to the plane shows the beam along the array; one that crosses the plane aslant is drawn out by the slice's thickness
over the tangent, with the phases of its points. Greys a dB come from speckle: a wire's own profile can't tell a wide beam from a
grey map of more dB. The scanner's aperture follows the depths that it shows, so beams are taken as in what it assumes.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recon.identification import sound_beam
from recon.identification.estimates import Estimate, Findings
from recon.identification.grey_map import few
from recon.identification.scanner import LIKELY, USUAL, Settings, Sheet
from recon.identification.sound_beam import Across, Along

Array = NDArray[np.float64]
Images = NDArray[np.uint8]

ALONG = ("receive_f_number", "transmit_f_number", "transmit_focus_mm", "aperture_mm")
ACROSS = ("elevation_mm", "elevation_focus_mm")
REACH_MM, ROWS_MM = 3.0, 0.8  # of an echo, along the array and in depth, to either side
SEEN_DB = 20.0  # under the top, as far as the profile counts
CLIPPED = (3, 250)  # greys beyond which it doesn't
STEP_MM = 0.05  # between points of a wire, across the plane
SQUARE = 0.15  # tangent of a wire's slant along the array, under which it shows no thickness
ERROR_DB = 1.0  # of a profile's point, of some ten that err together: interference of the wire's own echoes, rounding


class Sightings(NamedTuple):
    """Echoes of wires in images."""

    image: NDArray[np.int64]  # (n,) number
    pixel: Array  # (n, 2) px, column and row of the top
    direction: Array  # (n, 3) of the wires, in the image's frame: along the array, deep, across


class _Profile(NamedTuple):
    x_mm: Array  # (m,) beside the top's column
    db: Array  # (m,) under white
    depth_mm: float
    slants: tuple[float, float]  # along the array and in depth, a mm across the plane


def wires(images: Images, seen: Sightings, sheet: Sheet, greys_a_db: Estimate, settings: Settings = USUAL) -> Findings:
    """Find the beam by wires : images (n, h, w).

    greys_a_db : of the linear grey map, from speckle of the same setting
    """
    profiles = [each for each in (_profile(images, seen, n, sheet, greys_a_db.value) for n in range(len(seen.image))) if each]
    slanting = any(abs(each.slants[0]) > SQUARE for each in profiles)
    names = ALONG + ACROSS * slanting
    blind = {} if slanting else dict.fromkeys((f"ultrasound.{name}" for name in ACROSS), "all wires are square to the plane")
    if len(profiles) < 4:
        few_seen = dict.fromkeys((f"ultrasound.{name}" for name in names), f"{len(profiles)} wires are neither clipped nor faint")
        return Findings(unknown=few_seen | blind)
    prior = np.array([LIKELY[name] for name in names])
    f, n = sheet.frequency_mhz, len(names)

    def residuals(theta: Array, frequency: float = f.value, scale: float = 1.0) -> Array:
        wavelength = 1e-3 * sheet.assumed_speed / frequency
        receive, transmit, focus, widest = np.exp(theta[:4])
        beam = Along(wavelength, focus, transmit, receive, widest)
        slab = Across(wavelength, *np.exp(theta[4:6])) if slanting else None
        rest = []
        for k, profile in enumerate(profiles):
            shape = echo(beam, slab, profile.depth_mm, profile.x_mm - theta[n + k], profile.slants, wavelength)
            off = 20 * np.log10(np.maximum(shape, 1e-5)) - scale * profile.db
            rest.append((off - off.mean()) / ERROR_DB)
        return np.concatenate([*rest, (theta[:n] - prior[:, 0]) / prior[:, 1]])

    starts = _starts(residuals, np.r_[prior[:, 0], np.zeros(len(profiles))], slanting)
    best = min((least_squares(residuals, start, max_nfev=20, ftol=1e-5) for start in starts), key=lambda fit: fit.cost)
    inverse = np.linalg.inv(best.jac.T @ best.jac)
    ends = np.cumsum([len(profile.db) for profile in profiles])
    rows = np.split(np.arange(ends[-1]), ends[:-1])
    by_wire = np.array([best.jac[own_rows].T @ best.fun[own_rows] for own_rows in rows]) @ inverse
    fitted = n - float(np.trace(inverse[:n, :n] / prior[:, 1] ** 2))  # parameters that wires show, and not what was assumed
    freedom = max(len(profiles) - fitted, 1.0)  # a wire's points err together
    covariance = by_wire.T @ by_wire * len(profiles) / freedom * few(int(freedom)) ** 2
    for told in (
        (residuals(best.x, f.value + f.sigma) - residuals(best.x, f.value - f.sigma)) / 2,
        residuals(best.x, f.value, 1 + greys_a_db.sigma / greys_a_db.value) - best.fun,
    ):
        shift = inverse @ best.jac.T @ told
        covariance += np.outer(shift, shift)
    by_prior = inverse @ best.jac[-n:].T
    covariance += by_prior @ by_prior.T
    estimates, unknown = {}, blind
    for number, name in enumerate(names):
        value, sigma = float(np.exp(best.x[number])), float(np.hypot(np.sqrt(covariance[number, number]), settings.beam))
        if sigma > min(settings.relative, settings.seen * LIKELY[name][1]):
            unknown[f"ultrasound.{name}"] = f"wires' echoes hardly depend on it: {value:.2g} to {100 * sigma:.0f} %"
        else:
            source = f"echoes of {len(profiles)} wires, and the frequency"
            estimates[f"ultrasound.{name}"] = Estimate(value, value * sigma, source)
    return Findings(estimates, unknown)


def _starts(residuals: Callable[[Array], Array], usual: Array, slanting: bool) -> list[Array]:
    """Likely apertures and foci, the best of a coarse search: first along the array, then across."""
    tried = []
    for receive, transmit, focus in itertools.product((1.8, 2.6, 3.5), (2.0, 2.8, 3.8), (11.0, 15.0, 20.0, 27.0)):
        tried.append(usual.copy())
        tried[-1][:3] = np.log([receive, transmit, focus])
    best = sorted(tried, key=lambda start: float((residuals(start) ** 2).sum()))[:3]
    if not slanting:
        return best
    tried = []
    for start, height, focus in itertools.product(best, (3.3, 4.6, 6.5), (13.0, 18.0, 24.0)):
        tried.append(start.copy())
        tried[-1][4:6] = np.log([height, focus])
    return sorted(tried, key=lambda start: float((residuals(start) ** 2).sum()))[:3]


def _profile(images: Images, seen: Sightings, n: int, sheet: Sheet, greys_a_db: float) -> _Profile | None:
    """Brightest grey of each column about an echo's row, in dB; None of one that is clipped or cut off."""
    (sx, sy), (u, v) = sheet.mm_per_px, np.rint(seen.pixel[n]).astype(int)
    image = images[seen.image[n]]
    half, rows = int(REACH_MM / sx), int(ROWS_MM / sy)
    left, right, top, bottom = max(u - half, 0), min(u + half + 1, image.shape[1]), max(v - rows, 0), v + rows + 1
    if abs(seen.direction[n, 2]) < 0.2 or bottom > len(image):
        return None
    slants = seen.direction[n, :2] / seen.direction[n, 2]
    window = image[top:bottom, left:right].astype(float)
    profile = window.max(axis=0)
    x = sx * (np.arange(left, right) - seen.pixel[n, 0])
    highest = profile.max()
    kept = (profile > max(highest - SEEN_DB * greys_a_db, CLIPPED[0])) & (profile < CLIPPED[1])
    middle = int(profile.argmax())
    gaps = np.flatnonzero(~kept)
    low, high = gaps[gaps < middle], gaps[gaps > middle]
    kept[: low[-1] if len(low) else 0] = False
    kept[high[0] if len(high) else len(kept) :] = False
    if highest >= CLIPPED[1] or kept.sum() < 6 or highest < 60:
        return None
    return _Profile(
        x[kept], (profile[kept] - 255) / greys_a_db, sy * float(seen.pixel[n, 1]), (float(slants[0]), float(slants[1]))
    )


def echo(beam: Along, slab: Across | None, depth: float, x_mm: Array, slants: tuple[float, float], wavelength: float) -> Array:
    """Amplitude : (n,) of a wire's echo along the array, 1 at most: of all its points, each by its place and phase.

    slants : by which the wire runs along the array and deeper, a mm across the plane
    """
    if slab is None or abs(slants[0]) <= SQUARE:
        shape = np.abs(sound_beam.field_along(beam, depth, x_mm))
        return shape / np.abs(sound_beam.field_along(beam, depth, np.zeros(1)))
    z = np.arange(-slab.elevation_mm / 2 - 1, slab.elevation_mm / 2 + 1 + STEP_MM / 2, STEP_MM)
    weights = sound_beam.field_across(slab, depth, z, 0.5) * np.exp(4j * np.pi / wavelength * z * slants[1])
    grid = np.arange(0, 2 * REACH_MM + np.abs(z * slants[0]).max() + STEP_MM, STEP_MM / 2)
    table = sound_beam.field_along(beam, depth, grid)
    away = np.abs(x_mm[:, None] - z * slants[0])
    field = np.interp(away, grid, table.real) + 1j * np.interp(away, grid, table.imag)
    shape = np.abs(field @ weights)
    return shape / max(shape.max(), 1e-12)
