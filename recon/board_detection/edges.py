"""Sub-pixel edges along rough outlines, from the raw pixels beside them.

About each outline a band of pixels is modelled as a blurred step: the brightness on either side is a plane of its own, so that
a gradient of the light doesn't move the edge, nor does its blur; the blur is one width for the outline; and the band is cut into
sectors that each find where the step lies. Pixels are never interpolated, and each belongs to one sector, so edge points have
independent noise.

A straight edge of length l is found to `(n/C) sqrt(2 sqrt(pi) s / l)` px, with noise n, contrast C and blur s; from that follows
the limit of a disc's centre, `(n/C) sqrt(2 sqrt(pi) s / (pi R))`.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.geometry.ellipses import Ellipses, on_ellipse
from recon.geometry.order_statistics import quantile
from recon.threads import in_threads

Array = NDArray[np.float64]

STEPS = 5  # of Gauss and Newton; the caller repeats about a better outline anyway
SETTLED = 2e-3  # px, of nine tenths of the offsets
SHARED = 7  # planes of both sides and the blur
LEAST_BLUR = 0.25  # px: below it a step between two pixels can't be told from a blurred one
FLAT = 2.5  # blurs away from the edge the step is over
ROUNDING = 1 / 12  # DN^2, the variance of whole numbers
SCATTER = 10.0  # standard deviations beyond which a pixel counts less
BANDWIDTH = 1.5  # reaches, measured along the shorter axis: no pixel of the band is farther
KEPT = (1 - 6 / SCATTER**2) / (1 - 2 / SCATTER**2)  # of normal noise's variance, seen with pixels counting by their residuals
LOOSENESS = 1e-4  # of the mean information of a sector: keeps sectors without an edge in place


@dataclass(frozen=True)
class Edges:
    """Edge points of n outlines in m sectors each."""

    points: Array  # (n, m, 2) px
    normals: Array  # (n, m, 2), outwards
    sigma: Array  # (n, m) px along the normal; inf where a sector shows no edge
    shared: Array  # (n, m, 7) px, errors in common through brightness and blur, for one standard deviation each
    inside: Array  # (n,) DN, mean brightness
    outside: Array  # (n,) DN
    blur: Array  # (n,) px, standard deviation
    noise: Array  # (n,) DN, standard deviation of a pixel beside the edge
    clipped: Array  # (n,) share of the band's pixels that are as bright as the image can be


class _Rims(NamedTuple):
    """Rough outlines and the boxes that hold their bands."""

    centre: Array  # (n, 2) px
    inverse: Array  # (n, 2, 2) 1/px, of the shapes
    axes: Array  # (n, 2) px, the shorter and the longer semi-axis
    reach: Array  # (n,) px
    low: NDArray[np.int64]  # (n, 2) first column and row
    high: NDArray[np.int64]  # (n, 2) behind the last

    @staticmethod
    def of(outlines: Ellipses, reach: Array, shape: tuple[int, ...]) -> "_Rims":
        """Of ellipses, for an image of a shape."""
        extent = np.sqrt(np.einsum("nij,nij->ni", outlines.shape, outlines.shape)) + reach[:, None]
        low = np.clip(np.floor(outlines.centre - extent), 0, shape[::-1]).astype(np.int64)
        high = np.clip(np.ceil(outlines.centre + extent) + 1, 0, shape[::-1]).astype(np.int64)
        axes = np.linalg.eigvalsh(outlines.shape)
        return _Rims(np.array(outlines.centre), np.linalg.inv(outlines.shape), axes, np.array(reach, float), low, high)


class _Band(NamedTuple):
    """The pixels near all outlines, one after the other."""

    values: Array  # (p,) DN
    xy: Array  # (p, 2) offset from the centre, in radii
    normal: Array  # (p, 2) outwards, over the radius: how planes change across the edge
    distance: Array  # (p,) px from the rough outline, positive outside
    angle: Array  # (p,) rad
    starts: NDArray[np.int64]  # (n + 1,) where an outline's pixels begin

    @staticmethod
    def of(image: Array, outlines: Ellipses, reach: Array) -> "_Band":
        """All pixels of an image : (h, w) within reach of the outlines."""
        n, rims = len(outlines.centre), _Rims.of(outlines, reach, image.shape)
        sizes = np.zeros(n, np.int64)
        in_threads(_count, n, rims, sizes)
        starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        lengths, pairs = starts[-1], (starts[-1], 2)
        band = _Band(np.empty(lengths), np.empty(pairs), np.empty(pairs), np.empty(lengths), np.empty(lengths), starts)
        grey = np.ascontiguousarray(image, float)
        in_threads(_gather, n, grey, rims, band)
        return band

    @property
    def owner(self) -> NDArray[np.int64]:
        """Number of the outline : (p,)."""
        return np.repeat(np.arange(self.starts.size - 1), np.diff(self.starts))

    def first_levels(self) -> Array:
        """Planes of the inside and the outside : (n, 6), flat at first: the medians of the halves away from the edge."""
        levels = np.zeros((self.starts.size - 1, 6))
        in_threads(_fill_levels, len(levels), self, levels)
        return levels


class _Step(NamedTuple):
    """The blurred steps that the bands are compared with."""

    levels: Array  # (n, 6) DN, planes of the inside and the outside
    width: Array  # (n,) px, of the blur
    offset: Array  # (n, m) px, of the sectors' edges from the rough outline
    limit: Array  # (n,) DN, residual from which on a pixel counts less


def find_edges(
    image: Array, outlines: Ellipses, reach: Array, *, sectors: int = 64, blur: Array | None = None, full: float = 255
) -> Edges:
    """Find the edge along each outline.

    Parameters
    ----------
    image : (h, w) DN
        Any depth.
    outlines : Ellipses
        n rough outlines, to a third of `reach`.
    reach : (n,) px
        How far to look to either side. Nothing else should lie within; three blurs and two pixels are enough, more is better.
    sectors : int
        Edge points an outline.
    blur : (n,) px, optional
        What to start from.
    full : float
        Largest value that the image can have.
    """
    count = len(outlines.centre)
    band = _Band.of(image, outlines, reach)
    levels = band.first_levels()
    width = np.full(count, 1.0) if blur is None else np.array(blur, float)
    noise = np.full(count, np.inf)
    offset = np.zeros((count, sectors))
    for _ in range(STEPS):
        sums = _Sums.of(band, levels, width, offset, noise)
        change, move = sums.solve()
        levels += change[:, :6]
        width = np.clip(width + np.clip(change[:, 6], -0.4 * width, 0.6 * width), LEAST_BLUR, np.maximum(reach, LEAST_BLUR))
        offset = np.clip(offset + move, -reach[:, None] / 2, reach[:, None] / 2)
        noise = sums.noise()
        if np.percentile(np.abs(move), 90) < SETTLED:
            break
    sigma, shared = sums.uncertainty(noise)
    points, normals = on_ellipse(outlines, sums.angles())
    return Edges(
        points=points + offset[..., None] * normals,
        normals=normals,
        sigma=np.where(np.abs(offset) < reach[:, None] / 2, sigma, np.inf),
        shared=shared,
        inside=levels[:, 0],
        outside=levels[:, 3],
        blur=width,
        noise=noise,
        clipped=np.bincount(band.owner, band.values >= full, count) / np.maximum(np.diff(band.starts), 1),
    )


class _Sums(NamedTuple):
    """Normal equations of the step model: the offsets of the sectors, and the planes and the blur of their outline."""

    offset: Array  # (n, m) information on the offsets
    mixed: Array  # (n, m, 7) on offsets and rest
    rest: Array  # (n, 7, 7) on planes and blur
    toward_offset: Array  # (n, m) right side
    toward_rest: Array  # (n, 7)
    turn: Array  # (n, m) rad, from the sectors' middles to where their edges were seen, weighed by information
    flat: Array  # (n, 2, 2) number of pixels and sum of squares beside the edge, inside and outside
    near: Array  # (n, 2) the same of all pixels

    @staticmethod
    def of(band: _Band, levels: Array, width: Array, offset: Array, noise: Array) -> "_Sums":
        """Sum over the pixels. Pixels that stand out by many times the noise count less."""
        limit = SCATTER * np.maximum(noise, 0.02 * np.abs(levels[:, 3] - levels[:, 0]))
        step, (n, sectors) = _Step(levels, width, offset, limit), offset.shape
        sums = _Sums(
            np.zeros((n, sectors)), np.zeros((n, sectors, SHARED)), np.zeros((n, SHARED, SHARED)), np.zeros((n, sectors)),
            np.zeros((n, SHARED)), np.zeros((n, sectors)), np.zeros((n, 2, 2)), np.zeros((n, 2)),
        )  # fmt: skip
        in_threads(lambda first, end: _add_up(first, end, band, step, sums, np.empty(SHARED)), n)
        return sums

    @property
    def information(self) -> Array:
        """On the offsets : (n, m), never zero."""
        return self.offset + LOOSENESS * self.offset.mean(axis=1, keepdims=True) + 1e-12

    def rest_covariance(self) -> Array:
        """Of planes and blur when the offsets are free : (n, 7, 7), for unit noise."""
        reduced = self.rest - np.swapaxes(self.mixed, 1, 2) @ (self.mixed / self.information[..., None])
        ridge = 1e-9 * np.trace(self.rest, axis1=1, axis2=2)[:, None, None] + 1e-12
        return np.linalg.inv(reduced + ridge * np.eye(SHARED))

    def solve(self) -> tuple[Array, Array]:
        """Change of planes and blur : (n, 7), and of the offsets : (n, m), which are eliminated first."""
        right = self.toward_rest - np.einsum("nmk,nm->nk", self.mixed, self.toward_offset / self.information)
        change = (self.rest_covariance() @ right[..., None])[..., 0]
        return change, (self.toward_offset - np.einsum("nmk,nk->nm", self.mixed, change)) / self.information

    def noise(self) -> Array:
        """Standard deviation of a pixel : (n,) DN, the mean of both sides, beside the edge if there is room."""
        enough = self.flat[:, :, 0].min(axis=1) >= 20
        variance = (self.flat[:, :, 1] / np.maximum(self.flat[:, :, 0], 1)).mean(axis=1)
        variance = np.where(enough, variance, self.near[:, 1] / np.maximum(self.near[:, 0], 1))
        return np.sqrt(np.maximum(variance / KEPT, ROUNDING))

    def uncertainty(self, noise: Array) -> tuple[Array, Array]:
        """Noise of the offsets: each one's own : (n, m), and shared errors : (n, m, 7)."""
        covariance = self.rest_covariance()
        half = np.linalg.cholesky((covariance + np.swapaxes(covariance, 1, 2)) / 2)
        shared = noise[:, None, None] * (self.mixed / self.information[..., None]) @ half
        return noise[:, None] / np.sqrt(self.information), shared

    def angles(self) -> Array:
        """Where along the outline the edges were seen : (n, m) rad."""
        sectors = self.offset.shape[1]
        return (np.arange(sectors) + 0.5) / sectors * 2 * np.pi - np.pi + self.turn / np.maximum(self.offset, 1e-12)


@njit(inline="always")
def _nearest(x, y, inverse):
    """Distance of a point from an ellipse about the origin, angle and outward normal of the point next to it.

    As `recon.geometry.ellipses.signed_distance` and `on_ellipse`, for one point.
    """
    if x == 0 and y == 0:
        x = 1e-9  # the centre itself is next to any point
    a, b, c = inverse[0, 0], inverse[0, 1], inverse[1, 1]
    p, q = a * x + b * y, b * x + c * y  # on the unit circle
    radius = math.hypot(p, q)
    p, q = p / radius, q / radius
    slope_x, slope_y = a * p + b * q, b * p + c * q
    slope = math.hypot(slope_x, slope_y)
    bend = (p * (b * slope_x + c * slope_y) - q * (a * slope_x + b * slope_y)) ** 2 / (radius * slope**2)
    first = (radius - 1) / slope
    return first + bend * first**2 / (2 * slope), math.atan2(q, p), slope_x / slope, slope_y / slope


@njit(inline="always")
def _may_be_near(x, y, rims, i):
    """Whether a point could lie within reach of an outline: a test without roots of roots, for most pixels fail it."""
    inverse = rims.inverse[i]
    q = math.hypot(inverse[0, 0] * x + inverse[0, 1] * y, inverse[1, 0] * x + inverse[1, 1] * y)
    return abs(q - 1) * rims.axes[i, 0] < BANDWIDTH * rims.reach[i]


@kernel
def _count(first, end, rims, sizes):
    """Count the pixels of the bands `first` to `end`, not included."""
    for i in range(first, end):
        for v in range(rims.low[i, 1], rims.high[i, 1]):
            for u in range(rims.low[i, 0], rims.high[i, 0]):
                x, y = u - rims.centre[i, 0], v - rims.centre[i, 1]
                if _may_be_near(x, y, rims, i) and abs(_nearest(x, y, rims.inverse[i])[0]) <= rims.reach[i]:
                    sizes[i] += 1


@kernel
def _gather(first, end, image, rims, band):
    """Fill the bands `first` to `end`, not included, each where it begins."""
    values, xy, normal, distance, angle, starts = band
    for i in range(first, end):
        p, radius = starts[i], rims.axes[i, 1]
        for v in range(rims.low[i, 1], rims.high[i, 1]):
            for u in range(rims.low[i, 0], rims.high[i, 0]):
                x, y = u - rims.centre[i, 0], v - rims.centre[i, 1]
                if not _may_be_near(x, y, rims, i):
                    continue
                away, at, across, down = _nearest(x, y, rims.inverse[i])
                if abs(away) <= rims.reach[i]:
                    values[p], distance[p], angle[p] = image[v, u], away, at
                    xy[p, 0], xy[p, 1] = x / radius, y / radius
                    normal[p, 0], normal[p, 1] = across / radius, down / radius
                    p += 1


@kernel
def _add_up(first, end, band, step, sums, columns):
    """Fill the sums of the outlines `first` to `end`, not included; `columns` has room for a pixel's slopes."""
    for i in range(first, end):
        _add_outline(i, band, step, sums, columns)


@njit(inline="always")
def _add_outline(i, band, step, sums, columns):
    """Add one outline's pixels: measured less modelled, and the model's slopes.

    A plane `a + g t` that begins at t = 0, blurred by s, is `(a + g t) Phi(t/s) + g s phi(t/s)`.
    """
    sectors = step.offset.shape[1]
    inner, outer, s, limit = step.levels[i, :3], step.levels[i, 3:], step.width[i], step.limit[i]
    for p in range(band.starts[i], band.starts[i + 1]):
        at = (band.angle[p] / (2 * np.pi) + 0.5) * sectors
        j = int(at) % sectors
        x, y = band.xy[p, 0], band.xy[p, 1]
        z = (band.distance[p] - step.offset[i, j]) / s
        share = 0.5 * math.erfc(-z / math.sqrt(2.0))
        peak = math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
        inside, outside = inner[0] + inner[1] * x + inner[2] * y, outer[0] + outer[1] * x + outer[2] * y
        bent_x, bent_y = s * peak * band.normal[p, 0], s * peak * band.normal[p, 1]
        bent = (outer[1] - inner[1]) * bent_x + (outer[2] - inner[2]) * bent_y
        residual = band.values[p] - inside - (outside - inside) * share - bent
        slope = -(outside - inside) * peak / s
        columns[0], columns[3] = 1 - share, share
        columns[1], columns[2] = x * (1 - share) - bent_x, y * (1 - share) - bent_y
        columns[4], columns[5] = x * share + bent_x, y * share + bent_y
        columns[6] = slope * z
        w = 1 / (1 + (residual / limit) ** 2) ** 2
        sums.offset[i, j] += w * slope * slope
        sums.toward_offset[i, j] += w * slope * residual
        sums.turn[i, j] += w * slope * slope * (at - int(at) - 0.5) * 2 * np.pi / sectors
        for a in range(SHARED):
            sums.mixed[i, j, a] += w * slope * columns[a]
            sums.toward_rest[i, a] += w * columns[a] * residual
            for b in range(a + 1):
                sums.rest[i, a, b] += w * columns[a] * columns[b]
        sums.near[i, 0] += w
        sums.near[i, 1] += w * residual * residual
        if abs(z) > FLAT:
            sums.flat[i, int(z > 0), 0] += w
            sums.flat[i, int(z > 0), 1] += w * residual * residual
    for a in range(SHARED):
        for b in range(a):
            sums.rest[i, b, a] = sums.rest[i, a, b]


@njit(nogil=True)
def _fill_levels(first, end, band, levels):
    """Fill the first levels of the outlines `first` to `end`, not included."""
    for i in range(first, end):
        begin, behind = band.starts[i], band.starts[i + 1]
        inside, outside, m, n, far = np.empty(behind - begin), np.empty(behind - begin), 0, 0, 0.0
        for p in range(begin, behind):
            far = max(far, 0.4 * abs(band.distance[p]))
        for p in range(begin, behind):
            if band.distance[p] < -far:
                inside[m] = band.values[p]
                m += 1
            elif band.distance[p] > far:
                outside[n] = band.values[p]
                n += 1
        levels[i, 0] = quantile(inside[:m], 0.5) if m else 0.0
        levels[i, 3] = quantile(outside[:n], 0.5) if n else 0.0
