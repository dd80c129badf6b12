"""Uncertainty of a mass's place, volume and depth below the skin, by what places its B-scans, by sound, by
what moved the tissue, and by its border.

The poses of the track move the B-scans that lie beside them; the probe's calibration, the latency and tolerances of the tracking
move all of them together, and with them the border that they show. Where several B-scans show a point, it moves by the mean of
theirs. Another speed in the tissue scales the depths of all that lies above a mass, so its front and all of it move along the
beam. Its extent along the beam depends on the speed within, by which the border behind is placed
(`recon.segmentation.refraction`); refraction at its sides, which another speed changes too, is left out. Speckle blurs the border
itself, by `BORDER_MM` as a whole; the more it is curved, the less of it averages, and the more of it the fit takes off: bodies of
12 mm come out 0.06 mm too small on all sides, of 4 to 5 mm by 0.07 to 0.17 mm.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.estimation.covariance import propagate
from recon.freehand import place_uncertainty
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.probe import NAMES
from recon.segmentation.containment import Containment
from recon.segmentation.mass_surface import Mass
from recon.segmentation.rest import Rest

Array = NDArray[np.float64]

BORDER_MM = 0.06  # standard deviation of a border's place as a whole, along each axis and outwards, by speckle
ROUND_MM = 6.0  # radius of a body, below which the border's place outwards is uncertain in inverse proportion to it


class Sigma(NamedTuple):
    """Standard deviations of a mass; NaN where the calibration's covariance isn't known."""

    centre_mm: float  # as a distance in space
    volume_mm3: float
    depth_mm: float = np.nan  # of its least depth below the skin; NaN without one
    left_mm: float = np.nan  # of its centre, by pressure and breath that may be left alone; NaN where these aren't known


class Speeds(NamedTuple):
    """Relative standard deviations of the speeds of sound."""

    tissue: float
    within: float  # in the mass


@dataclass(frozen=True)
class Shown:
    """Vertices as B-scans show them: m pairs of both."""

    vertex: NDArray[np.int64]  # (m,)
    scan: NDArray[np.int64]  # (m,)
    pixel: Array  # (m, 2) u, v
    share: Array  # (m,) of the vertex, 1 in all for each


@dataclass(frozen=True)
class Weights:
    """Derivatives of a mass's figures by the places of its n vertices."""

    centre: Array  # (n, 3, 3) of the centre of gravity, its axes before those of the vertex
    volume: Array  # (n, 3) mm^2
    depth: Array  # (n, 3) of the least depth below the skin, zero without one

    @property
    def rows(self) -> Array:
        """All five figures, centre first : (n, 5, 3)."""
        return np.concatenate([self.centre, self.volume[:, None], self.depth[:, None]], axis=1)


def by_all(mass: Mass, scans: Scans, speeds: Speeds, under: Containment | None = None, rest: Rest | None = None) -> Sigma:
    """By all of these, which err independently; NaN without the calibration's covariance.

    under : the mass's containment in the skin, if there is one.
    rest : what was undone in the B-scans, if that is known.
    """
    weights, shown = weights_of(mass, under), shown_by(np.asarray(mass.mesh.vertices), scans)
    by_motion = np.zeros((5, 5)) if rest is None else by_rest(weights, shown, rest)
    left_mm = np.nan if rest is None else float(np.sqrt(np.trace(by_motion[:3, :3])))
    if scans.probe is None or scans.probe.uncertainty is None:
        return Sigma(np.nan, np.nan, left_mm=left_mm)
    covariance = _by_placing(weights, shown, scans) + by_speeds(mass, weights, shown, scans, speeds) + _by_border(mass, under)
    covariance += by_motion
    centre, volume, depth = np.sqrt([np.trace(covariance[:3, :3]), covariance[3, 3], covariance[4, 4]]).tolist()
    return Sigma(centre, volume, np.nan if under is None or not np.isfinite(under.least_mm) else depth, left_mm)


def weights_of(mass: Mass, under: Containment | None = None) -> Weights:
    """To first order: a border's flow through the faces, and where it is."""
    mesh, corners = mass.mesh, mass.mesh.faces.ravel()
    through = np.repeat(mesh.face_normals * mesh.area_faces[:, None] / 3, 3, axis=0)  # a third of a face is each corner's
    arms = np.repeat((mesh.triangles_center - mass.centre) / mass.volume, 3, axis=0)
    centre, volume = np.zeros((len(mesh.vertices), 3, 3)), np.zeros((len(mesh.vertices), 3))
    np.add.at(volume, corners, through)
    np.add.at(centre, corners, arms[:, :, None] * through[:, None, :])
    depth = np.zeros_like(volume)
    if under is not None and np.isfinite(under.least_mm):
        depth[under.nearest] = -under.normal
    return Weights(centre, volume, depth)


def shown_by(points: Array, scans: Scans) -> Shown:
    """B-scans that show points : (n, 3) mm, near their planes; one that none does counts as shown by the nearest."""
    size = np.array(scans.shape[::-1])
    pairs, pixels = [], []
    nearest, closest, seen = np.full((len(points), 3), np.nan), np.full(len(points), np.inf), np.zeros(len(points), bool)
    near_mm = 1.0  # of a B-scan's plane: a point there is shown by it
    for k in np.flatnonzero(np.isfinite(scans.world_from_pixel).all(axis=(1, 2))).tolist():
        world_from_pixel = scans.world_from_pixel[k]
        local = rigid.apply(np.linalg.inv(world_from_pixel), points)
        away = np.abs(local[:, 2]) * np.linalg.norm(world_from_pixel[:3, 2])
        beside = np.maximum(np.maximum(-0.5 - local[:, :2], local[:, :2] - (size - 0.5)), 0)
        away = np.hypot(away, np.linalg.norm(beside * np.linalg.norm(world_from_pixel[:3, :2], axis=0), axis=1))
        shown, closer = (beside == 0).all(axis=1) & (away < near_mm), away < closest
        pairs.append(np.column_stack([np.flatnonzero(shown), np.full(shown.sum(), k)]))
        pixels.append(local[shown, :2])
        nearest[closer], closest[closer] = np.column_stack([np.full(closer.sum(), k), local[closer, :2]]), away[closer]
        seen |= shown
    unseen = np.flatnonzero(~seen)
    vertex, scan = np.concatenate([*pairs, np.column_stack([unseen, nearest[unseen, 0].astype(int)])]).T
    pixel = np.concatenate([*pixels, nearest[unseen, 1:]])
    return Shown(vertex, scan, pixel, 1 / np.bincount(vertex, minlength=len(points))[vertex])


def _by_placing(weights: Weights, shown: Shown, scans: Scans) -> Array:
    """Covariance : (5, 5) of centre, volume and depth by what places the B-scans."""
    probe, errors = scans.probe, scans.errors
    assert probe is not None and probe.uncertainty is not None
    moved = _moved(weights, shown, place_uncertainty.probe_slopes(scans.world_from_pixel, probe)).sum(axis=0)
    covariance = propagate(moved, probe.uncertainty.ordered(NAMES))
    if errors is None:
        return covariance
    by_pose = _moved(weights, shown, place_uncertainty.pose_slopes(scans.world_from_pixel, probe))
    used = np.unique(shown.scan)
    by_each = np.einsum("nm,nfk->mfk", errors.shares[used], by_pose[used])  # neighbours lie between the same poses of the track
    covariance += np.einsum("mfk,mkl,mgl->fg", by_each, errors.poses, by_each)
    together = by_pose.sum(axis=0)
    covariance += together @ errors.shared[used].mean(axis=0) @ together.T
    by_lag = _moved(weights, shown, place_uncertainty.rate_slopes(errors.rates)).sum(axis=0)
    return covariance + errors.lag_s**2 * by_lag @ by_lag.T


def by_speeds(mass: Mass, weights: Weights, shown: Shown, scans: Scans, speeds: Speeds) -> Array:
    """Covariance : (5, 5) of centre, volume and depth: the tissue's speed moves the front, that within the border behind."""
    slopes = place_uncertainty.depth_slopes(scans.world_from_pixel, 0.0 if scans.probe is None else scans.probe.face_row)
    deeper = _moved(weights, shown, slopes).sum(axis=0)[:, 0]
    depth = np.linalg.norm(deeper[:3])
    along = deeper[:3] / depth
    half = np.ptp(np.asarray(mass.mesh.vertices) @ along) / 2
    by_tissue = np.concatenate([along * (depth - half), [0.0], deeper[4:]])
    by_within = np.concatenate([along * half, [mass.volume], [0.0]])
    return np.outer(by_tissue, by_tissue) * speeds.tissue**2 + np.outer(by_within, by_within) * speeds.within**2


def by_rest(weights: Weights, shown: Shown, rest: Rest) -> Array:
    """Covariance : (5, 5) of centre, volume and depth by what may be left of motions; each cause errs alike in all B-scans."""
    moved = rest.unknown(shown.scan, shown.pixel) * shown.share[:, None]
    by_cause = np.einsum("mfi,kmi->kf", weights.rows[shown.vertex], moved)
    return by_cause.T @ by_cause


def _by_border(mass: Mass, under: Containment | None) -> Array:
    """Covariance : (5, 5) of centre, volume and depth by the border's own scatter, and the skin's."""
    skin_mm = 0.0 if under is None else under.sigma_mm
    radius = (3 * mass.volume / (4 * np.pi)) ** (1 / 3)
    outwards = BORDER_MM * max(1.0, ROUND_MM / radius)
    return np.diag([BORDER_MM, BORDER_MM, BORDER_MM, outwards * mass.mesh.area, np.hypot(outwards, skin_mm)]) ** 2


def _moved(weights: Weights, shown: Shown, slopes: Array) -> Array:
    """Derivatives : (scans, 5, k) of the figures by errors of each B-scan; slopes : (scans, 3, 3, k), of the terms 1, u, v."""
    terms = np.column_stack([np.ones(len(shown.pixel)), shown.pixel]) * shown.share[:, None]
    at_vertex = np.einsum("mi,mixk->mxk", terms, slopes[shown.scan])
    result = np.zeros((len(slopes), 5, slopes.shape[-1]))
    np.add.at(result, shown.scan, weights.rows[shown.vertex] @ at_vertex)
    return result
