"""Contact of the array's face with the skin: the one place where what sound and tracking place meets what light measured.

The face touches the skin, through a little gel. So its measured distance from the measured skin checks all at once: the optics,
the tracking, the probe's calibration, the latency, and that the skin stayed where it was and as it was.

A skin that moved since the fringes changes each distance by the motion along its normal there. Along the beam that is a distance
alike in all B-scans, as a layer of gel makes, too. Aside it is a pattern along a curved skin, which errors of the probe hardly
make: they turn with it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import savgol_filter

from recon.estimation.covariance import inverse
from recon.files.metrics import Metrics
from recon.freehand import place_uncertainty
from recon.freehand.scans import Scans
from recon.segmentation.containment import below

Array = NDArray[np.float64]

PLACES, NEIGHBOURS = 45, 15  # along the face, a mm or so apart; and those that noise is smoothed over
CAUSES = "skin that is pressed, that moved since the fringes, devices that drifted, or a wrong lag"
UNEVEN = "did it, since the fringes, or is gel or pressure uneven"
LAGS = 1, 4  # B-scans, over which likeness fades by the process alone: noise of each is at 0
ROUNDS = 20  # of least squares, with weights by what the last one leaves
SMALLEST = 1e-300  # chance, below which it counts as this


@dataclass(frozen=True)
class ContactLimits:
    """When the face meets the skin."""

    gel_mm: float = 1.0  # of gel, that the face stands off at most without a word; assumed
    fewest: int = 5  # B-scans over the skin
    alarm_sigma: float = 3.0
    usual: float = 4.685  # standard deviations from the pattern, beyond which a B-scan counts nothing: 95 % efficient if normal
    curved: float = 0.05  # rad, by which normals along the sweep differ, RMS: of a flatter skin nothing is told aside
    foreign_mm: float = 3.0  # deeper within the skin than most: thinner than a finger, and more than a hand presses


LIMITS = ContactLimits()


@dataclass(frozen=True)
class Aside:
    """Motion of the skin across the beam since the fringes, as distances along a sweep show it.

    Gel or pressure that changes over a second and more makes such a pattern, too, beyond what sigma has: it is no alarm.
    """

    motion_mm: Array  # (3,) in the world
    sigma_mm: float  # standard deviation, in the direction that is known worst, of those that are known
    surprise: float  # standard deviations of a normal number as unlikely if the skin stayed


@dataclass(frozen=True)
class Contact:
    """Distances of the array's face from the skin, along a sweep."""

    distances_mm: Array  # (n,) of the nearest place of the face, negative within the skin; NaN beside it, or without a pose
    sigma_mm: float  # standard deviation of their median, by what errs alike in all; NaN where the calibration's isn't known
    aside: Aside | None = None  # None of too few B-scans or a flat skin, and where the calibration's errors aren't known

    @property
    def count(self) -> int:
        """Number of B-scans over the skin."""
        return int(np.isfinite(self.distances_mm).sum())

    @property
    def median_mm(self) -> float:
        """Median distance; NaN of too few."""
        return float(np.nanmedian(self.distances_mm)) if self.count >= LIMITS.fewest else np.nan

    @property
    def foreign(self) -> int:
        """Number of B-scans in which the face lies far deeper in the skin than in most."""
        return int(np.sum(self.distances_mm < min(self.median_mm, 0) - LIMITS.foreign_mm))

    @property
    def range_mm(self) -> tuple[float, float]:
        """What nine of ten B-scans lie between."""
        low, high = np.nanquantile(self.distances_mm, [0.05, 0.95]).tolist()
        return low, high

    @property
    def figures(self) -> Metrics:
        """Figures, each named with its unit; none of too few B-scans."""
        if np.isnan(self.median_mm):
            return {}
        low, high = self.range_mm
        spread = {"contact_low_mm": low, "contact_high_mm": high}
        found: Metrics = {"contact_mm": self.median_mm, "contact_sigma_mm": self.sigma_mm, **spread}
        if self.aside is not None:
            length = float(np.linalg.norm(self.aside.motion_mm))
            found |= {"contact_aside_mm": length, "contact_aside_sigma_mm": self.aside.sigma_mm}
        return found

    @property
    def lines(self) -> list[str]:
        """Lines on the distance and on a motion aside, and warnings where the face doesn't meet the skin."""
        if np.isnan(self.median_mm):
            return [f"contact     of the array's face with the skin isn't known: over it in {self.count} B-scans"]
        low, high = self.range_mm
        known = f" ± {self.sigma_mm:.2f}" if np.isfinite(self.sigma_mm) else ""
        span = f"{low:+.2f} to {high:+.2f} in nine B-scans of ten"
        most = LIMITS.alarm_sigma * self.sigma_mm  # a comparison with NaN is no alarm
        told = [f"contact     the array's face stands {self.median_mm:+.2f}{known} mm off the skin, {span}"]
        if most < self.median_mm <= LIMITS.gel_mm + most:
            told[0] += ": by gel, or a skin that has risen by that since the fringes, which look alike"
        if self.median_mm < -most:
            told.append(f"warning     contact: the face lies within the measured skin: {CAUSES}?")
        elif self.median_mm > LIMITS.gel_mm + most:
            told.append(f"warning     contact: the face doesn't reach the measured skin: much gel, or {CAUSES}?")
        if self.foreign:
            where = f"in {self.foreign} of {self.count} B-scans the face lies {LIMITS.foreign_mm:g} mm and more within the skin"
            told.append(f"warning     contact: {where}: did a hand or a cloth lie there under the fringes?")
        if self.aside is not None:
            length, sigma = float(np.linalg.norm(self.aside.motion_mm)), self.aside.sigma_mm
            if self.aside.surprise > LIMITS.alarm_sigma:
                place = ", ".join(f"{value:+.2f}" for value in self.aside.motion_mm)
                moved = f"by {length:.2f} ± {sigma:.2f} mm ({place}), {self.aside.surprise:.1f} sigma"
                told.append(f"aside       contact varies along the sweep as if the skin had moved aside {moved}: {UNEVEN}?")
            else:
                told.append(f"aside       the skin stayed, as far as contact shows: it moved by {length:.2f} ± {sigma:.2f} mm")
        return told


def measure(scans: Scans, skin: trimesh.Trimesh) -> Contact:
    """Distances of the face in each B-scan from a skin, with what is known of their errors."""
    row = 0.0 if scans.probe is None else scans.probe.face_row
    columns = np.linspace(0, scans.shape[1] - 1, PLACES)
    face = np.column_stack([columns, np.full(PLACES, row), np.zeros(PLACES), np.ones(PLACES)])
    placed = np.flatnonzero(np.isfinite(scans.world_from_pixel).all(axis=(1, 2)))
    places = np.einsum("nij,mj->nmi", scans.world_from_pixel[placed], face)[..., :3]
    depths, towards, _ = below(places.reshape(-1, 3), skin) if len(placed) else (np.empty(0), np.empty((0, 3)), None)
    heights = _smoothed(-depths.reshape(-1, PLACES))
    over = np.isfinite(heights).any(axis=1)
    nearest = np.nanargmin(heights[over], axis=1)
    distances = np.full(len(scans.world_from_pixel), np.nan)
    distances[placed[over]] = np.nanmin(heights[over], axis=1)
    normals = towards.reshape(-1, PLACES, 3)[np.flatnonzero(over), nearest]
    if not over.any() or scans.probe is None or scans.probe.uncertainty is None:
        return Contact(distances, np.nan)
    given = scans.world_from_pixel, scans.probe, scans.errors, placed[over], face[nearest, :2], normals
    of_probe = partial(place_uncertainty.covariance_of_sums, *given)
    return Contact(distances, place_uncertainty.mean_sigma(*given), _aside(distances[placed[over]], normals, of_probe))


def _smoothed(heights: Array) -> Array:
    """Heights : (n, m) mm along the face, by parabolas through some neighbours where all are known.

    The least of many noisy numbers is less than the least of what they are of.
    """
    known = np.isfinite(heights).all(axis=1)
    smooth = heights.copy()
    if known.any():
        smooth[known] = savgol_filter(heights[known], NEIGHBOURS, 2, axis=1)
    return smooth


def _aside(distances: Array, normals: Array, of_probe: Callable[[Array], Array]) -> Aside | None:
    """Motion of the skin across its mean normal, from distances : (n,) mm that each differ by it along normals : (n, 3).

    Least squares, in which B-scans that are far off count little or nothing (Tukey's biweight), over a distance alike in all. The
    hand's unsteadiness is in sigma by the scatter that is left, of which a part fades from B-scan to B-scan as an autoregressive
    process does.

    of_probe : covariance of sums of the distances, weighted : (k, n), by errors of the probe
    """
    across = np.linalg.svd(normals.mean(axis=0)[None])[2][1:]
    _, turns, axes = np.linalg.svd((normals - normals.mean(axis=0)) @ across.T, full_matrices=False)
    axes = axes[turns > LIMITS.curved * np.sqrt(len(normals))] @ across
    slopes = np.column_stack([np.ones(len(normals)), normals @ axes.T])
    if not len(axes) or len(distances) < slopes.shape[1] + LIMITS.fewest:
        return None
    found, most = np.append(np.median(distances), np.zeros(len(axes))), np.inf
    weights = solving = np.empty(0)
    for _ in range(ROUNDS):
        left = np.abs(distances - slopes @ found)
        most = LIMITS.usual * max(float(np.median(left)) / stats.norm.isf(0.25), place_uncertainty.GIVEN_MM)
        weights = np.maximum(1 - (left / most) ** 2, 0) ** 2
        solving = inverse(slopes.T * weights @ slopes) @ (slopes.T * weights)
        found = solving @ distances
    left = np.sqrt(weights) * (distances - slopes @ found)
    scatter = max(float(left @ left), len(left) * place_uncertainty.GIVEN_MM**2)
    near, far = (max(float(left[lag:] @ left[:-lag]), 0.0) for lag in LAGS)
    alike = min(far / near, 1.0) ** (1 / (LAGS[1] - LAGS[0])) if near else 0.0
    longer = min(1 + 2 * near / scatter / max(1 - alike, 1 / len(left)), len(left))  # B-scans that count as one
    free = max(len(left) / longer - slopes.shape[1], 1.0)
    by_hand = scatter / free * inverse(slopes.T * weights @ slopes)
    covariance = by_hand[1:, 1:] + of_probe(solving[1:])
    statistic = found[1:] @ np.linalg.solve(covariance, found[1:]) / len(axes)
    chance = max(float(stats.f.sf(statistic, len(axes), free)), SMALLEST)
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    return Aside(found[1:] @ axes, sigma, float(stats.norm.isf(chance / 2)))
