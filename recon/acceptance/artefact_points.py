"""Artefacts found in measured points, of which some are the table, a holder or a background.

Balls are found by their normals: from each point of a ball, its centre lies a radius inwards, so that all its points vote for one
place. No camera is needed, so that points of any scanner will do.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, KDTree

from recon.acceptance.certificates import Artefacts, BarCertificate
from recon.errors import InputError
from recon.geometry.primitives import Sphere, fit_plane, fit_sphere

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Region:
    """Points of an artefact that are taken."""

    cap_deg: float = 50.0  # of a ball, from the middle of what is seen of it: at its rim fringes thin out
    rod_deg: float = 10.0  # around a bar's rod, from its surface, as seen from the ball's centre
    near: float = 0.1  # of a ball's radius, from its surface: farther points are none of its
    near_mm: float = 2.0  # from a plane
    border_mm: float = 5.0  # of a plane, from its outline inwards, that is left out: pixels there see its edge, too
    least: int = 200  # points of an artefact
    most: int = 20_000  # that are fitted, evenly out of more
    votes: int = 2000  # points that vote
    window: float = 0.2  # of a ball's radius, in which normals are measured
    roundness: float = 0.05  # relative, by which a diameter may differ from that certified


REGION = Region()
PLANES = 300  # tried through three points each


def ball(points: Array, diameter_mm: float, name: str, region: Region = REGION) -> Array:
    """Points : (m, 3) of a ball among points : (n, 3) mm; InputError if there is none of this size."""
    return _thinned(points[_balls(points, (diameter_mm,), name, region)[0][1]], region)


def bar(points: Array, certificate: BarCertificate, name: str, region: Region = REGION) -> tuple[Array, Array]:
    """Points : (m, 3) of each of a bar's balls, beside its rod, among points : (n, 3) mm; InputError if they aren't there."""
    diameters = (certificate.diameters[0].mm, certificate.diameters[1].mm)
    first, second = _balls(points, diameters, name, region)
    apart = second[0].centre - first[0].centre
    length = float(np.linalg.norm(apart))
    if abs(length / certificate.length.mm - 1) > region.roundness:
        raise InputError(f"{name}: expected balls {certificate.length.mm:g} mm apart, found some {length:.2f} mm: another bar?")
    kept = []
    for (sphere, own), towards in ((first, apart), (second, -apart)):
        away = points[own] - sphere.centre
        angle = np.arccos(np.clip(away @ towards / (np.linalg.norm(away, axis=1) * length), -1, 1))
        hidden = np.arcsin(certificate.rod_mm / (2 * sphere.radius)) + np.deg2rad(region.rod_deg)
        kept.append(_enough(own[angle > hidden], name, region))
    return _thinned(points[kept[0]], region), _thinned(points[kept[1]], region)


def plate(points: Array, name: str, rng: np.random.Generator, region: Region = REGION) -> Array:
    """Points : (m, 3) of the plane that most points : (n, 3) mm are near to; InputError if they are too few."""
    if len(points) >= region.least:
        some = points[rng.integers(0, len(points), (PLANES, 3))]
        normals = np.cross(some[:, 1] - some[:, 0], some[:, 2] - some[:, 0])
        with np.errstate(invalid="ignore"):
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)  # none of points in a line, to which nothing is near
        few = points[:: max(1, len(points) // region.votes)]
        off = np.abs(few @ normals.T - np.sum(some[:, 0] * normals, axis=1))
        best = int((off < region.near_mm / 2).sum(axis=0).argmax())
        own = np.abs((points - some[best, 0]) @ normals[best]) < region.near_mm
        for _ in range(2):
            if own.sum() >= region.least:
                own = np.abs(fit_plane(points[own]).shape.distance(points)) < region.near_mm
        return _thinned(_within(points[_enough(np.flatnonzero(own), name, region)], region.border_mm), region)
    raise InputError(f"{name}: expected a plane of {region.least} points or more, found {len(points)}")


def expected(artefacts: Artefacts) -> tuple[str, ...]:
    """Names of the folders of an acceptance test, by the artefacts that there are."""
    return tuple(kind for kind in ("sphere", "bar", "plane", "divots", "filaments") if getattr(artefacts, kind) is not None)


def _within(points: Array, border_mm: float) -> Array:
    """Those of a plane's points : (n, 3) that are farther than a border from their convex outline."""
    away = points - points.mean(axis=0)
    across = away @ np.linalg.svd(away, full_matrices=False)[2][:2].T
    sides = ConvexHull(across).equations
    return points[(across @ sides[:, :2].T + sides[:, 2]).max(axis=1) < -border_mm]


def _thinned(points: Array, region: Region) -> Array:
    return points[:: -(-len(points) // region.most)]


def _enough(own: NDArray[np.intp], name: str, region: Region) -> NDArray[np.intp]:
    if len(own) < region.least:
        raise InputError(f"{name}: expected {region.least} points or more of the artefact, found {len(own)}")
    return own


def _balls(points: Array, diameters_mm: tuple[float, ...], name: str, region: Region) -> list[tuple[Sphere, NDArray[np.intp]]]:
    """Balls of diameters of one size or nearly, in the order of their x, each with the numbers of its points."""
    radius = sum(diameters_mm) / len(diameters_mm) / 2
    votes, found = _votes(points, radius, region), []
    for _ in diameters_mm:
        one = _ball(points, votes, radius, region)
        if one is not None and any(np.linalg.norm(one[0].centre - other.centre) < radius for other, _ in found):
            one = None  # the same again
        if one is None or abs(one[0].radius / radius - 1) > region.roundness:
            sizes = ", ".join(f"{2 * sphere.radius:.2f} mm" for sphere, _ in [*found, *([one] if one else [])]) or "none"
            wanted = f"{len(diameters_mm)} ball{'s' * (len(diameters_mm) > 1)} of {2 * radius:g} mm"
            raise InputError(f"{name}: expected {wanted}, found {sizes}: is it the certified diameter, and is it seen whole?")
        found.append(one)
        votes = votes[np.linalg.norm(votes - one[0].centre, axis=1) > radius]
    return sorted(found, key=lambda one: one[0].centre[0])


def _votes(points: Array, radius: float, region: Region) -> Array:
    """Centres : (m, 3) mm of balls on which points : (n, 3) would lie, on both sides of the surface, by its normals."""
    if len(points) < region.least:
        return np.zeros((0, 3))
    few = points[:: -(-len(points) // (10 * region.votes))]
    places = few[:: -(-len(few) // region.votes)]
    _, around = KDTree(few).query(places, k=24, distance_upper_bound=region.window * radius)
    known = (around < len(few)).sum(axis=1) >= 8
    around, places = around[known], places[known]
    held = around < len(few)
    beside = np.where(held[..., None], few[np.minimum(around, len(few) - 1)] - places[:, None], 0.0)
    beside -= np.where(held[..., None], beside.sum(axis=1, keepdims=True) / held.sum(axis=1)[:, None, None], 0.0)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", beside, beside))[1][..., 0] if len(places) else np.zeros((0, 3))
    return np.concatenate([places + radius * normals, places - radius * normals])


def _ball(points: Array, votes: Array, radius: float, region: Region) -> tuple[Sphere, NDArray[np.intp]] | None:
    """The ball that most votes are for, with the numbers of its points; None where it has too few."""
    if not len(votes):
        return None
    tree = KDTree(votes)
    middle = votes[np.argmax(tree.query_ball_point(votes, region.near * radius, return_length=True))]
    sphere = Sphere("", votes[tree.query_ball_point(middle, 2 * region.near * radius)].mean(axis=0), radius)
    own = np.zeros(0, np.intp)
    for _ in range(3):
        away = points - sphere.centre
        distance = np.linalg.norm(away, axis=1)
        near = np.flatnonzero(np.abs(distance - sphere.radius) < region.near * radius)
        if len(near) < region.least:
            return None
        outwards = away[near] / distance[near, None]
        axis = np.median(outwards, axis=0)
        for _ in range(3):  # towards the middle of what is seen, apart from what only touches the shell
            axis /= np.linalg.norm(axis)
            axis = outwards[outwards @ axis > 0].mean(axis=0)
        axis /= np.linalg.norm(axis)
        own = near[outwards @ axis > np.cos(np.deg2rad(region.cap_deg))]
        if len(own) < region.least:
            return None
        try:
            sphere = fit_sphere(_thinned(points[own], region)).shape
        except ValueError:  # a plane
            return None
    return sphere, own
