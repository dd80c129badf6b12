"""Curves on the skin: laid there along lines of sight, cut into dashes, and widened to strips of a width in mm."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from recon.skin_projection.lines_of_sight import NOWHERE, Sight, first_hits

Array = NDArray[np.float64]
Kind = Literal["mass", "cut", "scan", "name", "stroke"]
STEP_MM = 0.3  # between points of a curve: a chord leaves a circle of 5 mm by 0.002 mm
OPEN = np.deg2rad(100)  # widest sector about the hole without skin


@dataclass(frozen=True, eq=False)
class SkinCurve:
    """A curve on the skin as a chain of points; where one is missing, the chain is broken."""

    name: str
    kind: Kind
    points: Array  # (n, 3) mm in the world, NaN where there is no skin; a closed curve ends where it begins
    normals: Array  # (n, 3), of the skin there, towards where it was looked at from

    @property
    def on_skin(self) -> float:
        """Share of the points that lie on the skin."""
        return float(np.isfinite(self.points).all(axis=1).mean())

    @property
    def length_mm(self) -> float:
        """Of all pieces."""
        return float(np.nansum(np.linalg.norm(np.diff(self.points, axis=0), axis=1)))


def laid(name: str, kind: Kind, chain: Array, sight: Sight, skin: trimesh.Trimesh) -> SkinCurve:
    """The curve where lines of sight, by a chain of their places : (n, 2) on the chart, first meet the skin.

    Small holes of the skin, as gloss leaves them, are bridged; see `skin_gaps`.
    """
    hits = first_hits(sight, chain, skin)
    hit = hits.faces != NOWHERE
    if not hit.any():
        return SkinCurve(name, kind, hits.points, np.full_like(hits.points, np.nan))
    points = _bridge(hits.points, chain, sight, skin)
    normals = np.asarray(skin.vertex_normals)[skin.faces[hits.faces[hit]]].mean(axis=1)
    number = np.arange(len(chain))
    normals = np.column_stack([np.interp(number, number[hit], axis) for axis in normals.T])  # over holes, too
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    nearer = sight.chart(points + normals)[:, 2] > sight.chart(points)[:, 2]
    normals = np.where(nearer[:, None], normals, -normals)
    return SkinCurve(name, kind, points, np.where(np.isfinite(points), normals, np.nan))


def evenly(chain: ArrayLike, step: float = STEP_MM) -> Array:
    """A chain of points : (n, d), to one at even distances along it : (m, d), both ends kept."""
    chain = np.asarray(chain, float)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    wanted = np.linspace(0, along[-1], max(2, round(along[-1] / step) + 1))
    return np.column_stack([np.interp(wanted, along, axis) for axis in chain.T])


def edges(curve: SkinCurve, width_mm: float) -> tuple[Array, Array]:
    """The two edges of a strip on the skin with the curve in its middle : (n, 3) mm each, NaN where it is broken."""
    points = curve.points
    closed = len(points) > 2 and np.array_equal(points[0], points[-1])
    before, after = (points[-2], points[1]) if closed else (points[0], points[-1])
    ahead = np.concatenate([points[1:], [after]])
    behind = np.concatenate([[before], points[:-1]])
    ahead, behind = (np.where(np.isfinite(one), one, points) for one in (ahead, behind))  # at the ends of pieces
    aside = np.cross(curve.normals, ahead - behind)
    length = np.linalg.norm(aside, axis=1)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        half = np.where(length > 0, aside / length, np.nan) * width_mm / 2
    return points + half, points - half


def dashed(curve: SkinCurve, dash_mm: tuple[float, float] | None) -> NDArray[np.bool_]:
    """Whether each piece between two points : (n - 1,) is drawn, of a curve in dashes and gaps of some lengths; None is all."""
    steps = np.linalg.norm(np.diff(curve.points, axis=0), axis=1)
    if dash_mm is None:
        return np.isfinite(steps)
    middle = np.cumsum(np.nan_to_num(steps)) - np.nan_to_num(steps) / 2
    return np.isfinite(steps) & (middle % sum(dash_mm) < dash_mm[0])


def strip(curve: SkinCurve, width_mm: float, above_mm: float = 0.0) -> trimesh.Trimesh:
    """The strip as triangles, raised above the skin by some mm; without any where the curve has no piece."""
    left, right = (edge + above_mm * curve.normals for edge in edges(curve, width_mm))
    whole = np.isfinite(left).all(axis=1)
    k = np.flatnonzero(whole[:-1] & whole[1:])
    n = len(left)
    faces = np.concatenate([np.column_stack([k, k + n, k + 1]), np.column_stack([k + 1, k + n, k + n + 1])])
    mesh = trimesh.Trimesh(np.nan_to_num(np.concatenate([left, right])), faces, process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def _bridge(points: Array, chain: Array, sight: Sight, skin: trimesh.Trimesh) -> Array:
    """A curve's points on the skin : (n, 3) mm, with those over small holes, which are NaN, bridged.

    Gloss leaves such holes where it saturates the cameras. The skin around one is fitted by a quadratic on the chart: over 8 mm
    of skin that is bent with a radius of 60 mm a chord would be off by 0.13 mm. A hole that skin doesn't surround stays open.

    chain : (n, 2), of their places on the chart; one that ends where it begins is closed
    """
    missing = np.isnan(points[:, 0])
    if not missing.any() or missing.all():
        return points
    result, charted = points.copy(), sight.chart(skin.vertices)
    widest_mm = 15.0  # way of a curve over a hole
    uneven_mm = 0.3  # standard deviation of the skin about the quadratic, beyond which it isn't bridged
    for gap in _gaps(missing, bool((chain[0] == chain[-1]).all())):
        places = chain[gap]
        way = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
        nearness = _patch(places, charted) if way <= widest_mm else None
        if nearness is not None:
            filled, uneven = nearness
            at = sight.world(np.column_stack([places, filled]))
            off = sight.world(np.column_stack([places, filled + uneven])) - at
            if np.linalg.norm(off, axis=1).max() <= uneven_mm:
                result[gap] = at
    return result


def _gaps(missing: NDArray[np.bool_], closed: bool) -> Iterator[NDArray[np.int64]]:
    """Numbers of points in each run of missing ones that has known ones at both ends; round the seam of a closed chain, too."""
    n = len(missing)
    count = n - 1 if closed else n  # the last one of a closed chain is the first
    start = int(np.flatnonzero(~missing[:count])[0])
    order = (start + np.arange(count + closed)) % count
    order = order[: np.flatnonzero(~missing[order])[-1] + 1]
    runs = np.flatnonzero(np.diff(missing[order].astype(int)))
    for first, last in zip(runs[::2], runs[1::2], strict=True):
        gap = order[first + 1 : last + 1]
        yield np.append(gap, n - 1) if closed and 0 in gap else gap


def _patch(places: Array, charted: Array) -> tuple[Array, float] | None:
    """Nearness : (k,) at places on the chart by the skin around them, and the skin's standard deviation; None for its rim."""
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    around_mm = 4.0  # of the skin, beyond the curve's ends at the hole
    reach = np.linalg.norm(places - middle, axis=1).max() + around_mm
    off = charted[:, :2] - middle
    near = np.einsum("ij,ij->i", off, off) < reach**2
    fewest = 50  # vertices around
    if np.count_nonzero(near) < fewest:
        return None
    angles = np.sort(np.arctan2(off[near, 1], off[near, 0]))
    if np.diff(angles, append=angles[0] + 2 * np.pi).max() > OPEN:
        return None
    known = charted[near, 2]
    terms, *_ = np.linalg.lstsq(_quadratic(off[near] / reach), known, rcond=None)
    uneven = float(np.std(known - _quadratic(off[near] / reach) @ terms))
    return _quadratic((places - middle) / reach) @ terms, uneven


def _quadratic(places: Array) -> Array:
    x, y = places.T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
