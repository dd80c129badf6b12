"""Contact of the array's face with the skin: the one place where what sound and tracking place meets what light measured.

The face touches the skin, through a little gel. So its measured distance from the measured skin checks all at once: the optics,
the tracking, the probe's calibration, the latency, and that the skin stayed where it was and as it was.

A skin that moved along the beam since the fringes is a distance alike in all B-scans, as a layer of gel makes, too. One that
moved aside is a pattern along a curved skin, but so is gel or pressure that changes slowly: nothing is claimed of it.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from recon.files.metrics import Metrics
from recon.freehand import place_uncertainty
from recon.freehand.scans import Scans
from recon.segmentation.containment import below

Array = NDArray[np.float64]

PLACES, NEIGHBOURS = 45, 15  # along the face, a mm or so apart; and those that noise is smoothed over
CAUSES = "skin that is pressed, that moved since the fringes, devices that drifted, or a wrong lag"


@dataclass(frozen=True)
class ContactLimits:
    """When the face meets the skin."""

    gel_mm: float = 1.0  # of gel, that the face stands off at most without a word; assumed
    fewest: int = 5  # B-scans over the skin, and over a foreign thing
    given_mm: float = 0.05  # standard deviation by which a bracket gives between wires and sweep; assumed: a printed one, pressed
    alarm_sigma: float = 3.0
    foreign_mm: float = 3.0  # deeper within the skin than most: thinner than a finger, and more than a hand presses


LIMITS = ContactLimits()


@dataclass(frozen=True)
class Contact:
    """Distances of the array's face from the skin, along a sweep."""

    distances_mm: Array  # (n,) of the nearest place of the face, negative within the skin; NaN beside it, or without a pose
    sigma_mm: float  # standard deviation of their median, by what errs alike in all; NaN where the calibration's isn't known

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
        return {"contact_mm": self.median_mm, "contact_sigma_mm": self.sigma_mm, **spread}

    @property
    def lines(self) -> list[str]:
        """A line, and warnings where the face doesn't meet the skin."""
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
        if self.foreign >= LIMITS.fewest:
            where = f"in {self.foreign} of {self.count} B-scans the face lies {LIMITS.foreign_mm:g} mm and more within the skin"
            told.append(f"warning     contact: {where}: did a hand or a cloth lie there under the fringes?")
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
    used, at = placed[over], face[nearest, :2]
    sigma = place_uncertainty.mean_sigma(scans.world_from_pixel, scans.probe, scans.errors, used, at, normals)
    return Contact(distances, float(np.hypot(LIMITS.given_mm, sigma)))


def _smoothed(heights: Array) -> Array:
    """Heights : (n, m) mm along the face, by parabolas through some neighbours where all are known.

    The least of many noisy numbers is less than the least of what they are of.
    """
    known = np.isfinite(heights).all(axis=1)
    smooth = heights.copy()
    if known.any():
        smooth[known] = savgol_filter(heights[known], NEIGHBOURS, 2, axis=1)
    return smooth
