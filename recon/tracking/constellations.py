"""Rings of both views, the points where their rays meet, and the bodies whose circles lie like some of these points.

Distances between points don't depend on where a body stands. So three points or more are a body if they are as far apart as its
circles are, whatever else is in view; names follow from the distances, without the detector's word.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera
from recon.geometry.ellipses import Ellipses, joined
from recon.geometry.pose_hypotheses import POINTS
from recon.model import circle_layout
from recon.model.rig import Target
from recon.tracking import circle_segmenter, views
from recon.tracking.networks import Networks
from recon.tracking.pose import APART_MM, GROSS_MM
from recon.tracking.pose_fit import meet
from recon.tracking.rims import Outlines, measure, reach_px

Array = NDArray[np.float64]

STEPS = (1.0, 2.0, 0.5)  # px of the image that make one of a patch, that are tried one after the other
SIZES = 0.25  # of a radius, by which a ring by its width and distance may differ from a body's: it is tilted, and blurred
MOST_POINTS = 60  # where rays meet, the nearest first
KEPT = 8  # ways to take points for a body's circles that are looked at


@dataclass(frozen=True)
class Points:
    """m points where rays of two rings meet, one of each view."""

    rings: NDArray[np.int64]  # (m, 2) number of each view's ring
    places: Array  # (m, 3) mm
    radius_mm: Array  # (m,) of the ring, by its width in both views

    def without(self, taken: Collection[tuple[int, int]]) -> "Points":
        """The same without those of some rings, by view and number."""
        free = np.array([(0, i) not in taken and (1, j) not in taken for i, j in self.rings.tolist()], bool)
        return Points(self.rings[free], self.places[free], self.radius_mm[free])


def rings_of(frame: NDArray, places: Array, networks: Networks, target: Target) -> Outlines:
    """Rings about places : (n, 2) px that may be circles' middles, each once; of a hole as large as a target's."""
    rough, missing = [Ellipses(np.empty((0, 2)), np.empty((0, 2, 2)))], places
    for step in STEPS:
        if not len(missing):
            break
        cut = circle_segmenter.patches(frame, missing, step)
        found = circle_segmenter.read(networks.segment(cut.images), cut)
        there = np.isfinite(found.centre).all(axis=1)
        rough.append(found[there])
        missing = missing[~there]
    whole = joined(rough)
    rims = measure(frame, whole, reach_px(whole, circle_segmenter.OFF), target)
    return rims[_once(rims)]


def _once(rims: Outlines) -> list[int]:
    """Numbers of the rims that are rings, without those that are another one's again."""
    kept: list[int] = []
    near = np.trace(rims.ellipses.shape, axis1=1, axis2=2) / 2
    for k in np.flatnonzero(rims.found).tolist():
        away = np.linalg.norm(rims.ellipses.centre[kept] - rims.ellipses.centre[k], axis=1)
        if not (away < near[k]).any():
            kept.append(k)
    return kept


def points_of(rings: tuple[Outlines, Outlines], cameras: tuple[Camera, Camera]) -> Points:
    """Points where rays of rings of two views meet to `APART_MM`, of which both views' widths make one radius."""
    i, j = (index.ravel() for index in np.indices([len(each.reasons) for each in rings]))
    ellipses = rings[0].ellipses[i], rings[1].ellipses[j]
    places, gaps = meet(cameras, [each.centre for each in ellipses])
    radii = np.column_stack([_radius(camera, each, places) for camera, each in zip(cameras, ellipses, strict=True)])
    with np.errstate(invalid="ignore"):
        alike = np.abs(radii[:, 0] - radii[:, 1]) < SIZES * radii.min(axis=1)
        good = np.flatnonzero(np.isfinite(places).all(axis=1) & (np.abs(gaps) < APART_MM) & alike)
    good = good[np.argsort(np.abs(gaps[good]), kind="stable")][:MOST_POINTS]
    return Points(np.column_stack([i, j])[good], places[good], radii[good].mean(axis=1))


def _radius(camera: Camera, ellipses: Ellipses, places: Array) -> Array:
    """Radii : (n,) mm of rings at places : (n, 3) mm by their larger semi-axes."""
    depth = (places @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3])[:, 2]
    return np.linalg.eigvalsh(ellipses.shape)[:, 1] * depth / camera.matrix[0, 0]


def choices(points: Points, target: Target, least: int = POINTS) -> list[NDArray[np.int64]]:
    """Ways to take points for a target's circles : (n,) numbers of points, -1 of a circle that isn't seen; the likeliest first.

    They take as many points as lie like circles, and of these the ones whose distances are nearer to the target's come first.

    Parameters
    ----------
    least : circles that are seen by both cameras; two leave the others to be sought in either
    """
    radius = target.outer_diameter_mm / 2
    fit = np.flatnonzero(np.abs(points.radius_mm - radius) < SIZES * radius)
    model = circle_layout.circle_centres(target)
    expected = np.linalg.norm(model[:, None] - model, axis=-1)
    far = np.linalg.norm(points.places[fit][:, None] - points.places[fit], axis=-1)
    rings = points.rings[fit]
    shared = (rings[:, None] == rings).any(axis=-1)  # two circles are never one ring

    def extended(chosen: tuple[int, ...], unseen: int) -> Iterator[tuple[int, ...]]:
        k = len(chosen)
        if k == len(model):
            yield chosen
            return
        seen = [(number, one) for number, one in enumerate(chosen) if one >= 0]
        if len(model) - k > unseen:
            for new in range(len(fit)):
                if all(not shared[new, one] and abs(far[new, one] - expected[k, number]) < GROSS_MM for number, one in seen):
                    yield from extended((*chosen, new), unseen)
        if unseen:
            yield from extended((*chosen, -1), unseen - 1)

    def off(chosen: tuple[int, ...]) -> float:
        seen = [(number, one) for number, one in enumerate(chosen) if one >= 0]
        return sum((far[a, b] - expected[i, j]) ** 2 for i, a in seen for j, b in seen)

    for unseen in range(len(model) - least + 1):
        if found := sorted(extended((), unseen), key=off)[:KEPT]:
            return [np.where(np.array(one) < 0, -1, fit[list(one)]) for one in found]
    return []


def chosen_rims(rings: tuple[Outlines, Outlines], points: Points, choice: NDArray[np.int64]) -> list[Outlines]:
    """The rims of both views that a choice : (n,) takes for a body's circles."""
    unseen = views.nothing("not seen by both cameras", 1).outlines
    return [
        Outlines.joined([each, unseen])[np.where(choice < 0, len(each.reasons), points.rings[choice, k])]
        for k, each in enumerate(rings)
    ]
