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

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.geometry.ellipses import Ellipses, on_ellipse, signed_distance

Array = NDArray[np.float64]

STEPS = 5  # of Gauss and Newton; the caller repeats about a better outline anyway
SETTLED = 2e-3  # px, of nine tenths of the offsets
SHARED = 7  # planes of both sides and the blur
LEAST_BLUR = 0.25  # px: below it a step between two pixels can't be told from a blurred one
FLAT = 2.5  # blurs away from the edge the step is over
ROUNDING = 1 / 12  # DN^2, the variance of whole numbers
SCATTER = 10.0  # standard deviations beyond which a pixel counts less
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


@dataclass(frozen=True)
class _Band:
    """The pixels near all outlines, one after the other."""

    values: Array  # (p,) DN
    xy: Array  # (p, 2) offset from the centre, in radii
    normal: Array  # (p, 2) outwards, over the radius: how planes change across the edge
    distance: Array  # (p,) px from the rough outline, positive outside
    angle: Array  # (p,) rad
    starts: NDArray[np.int64]  # (n + 1,) where an outline's pixels begin

    @property
    def owner(self) -> NDArray[np.int64]:
        """Number of the outline : (p,)."""
        return np.repeat(np.arange(self.starts.size - 1), np.diff(self.starts))


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
    band = _band(image, outlines, reach)
    levels = _first_levels(band, count)
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


@dataclass(frozen=True)
class _Sums:
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
        n, m = offset.shape
        limit = SCATTER * np.maximum(noise, 0.02 * np.abs(levels[:, 3] - levels[:, 0]))
        sums = _Sums(
            np.zeros((n, m)), np.zeros((n, m, SHARED)), np.zeros((n, SHARED, SHARED)), np.zeros((n, m)), np.zeros((n, SHARED)),
            np.zeros((n, m)), np.zeros((n, 2, 2)), np.zeros((n, 2)),
        )  # fmt: skip
        _add_up(
            band.values, band.xy, band.normal, band.distance, band.angle, band.starts, levels, width, offset, limit,
            sums.offset, sums.mixed, sums.rest, sums.toward_offset, sums.toward_rest, sums.turn, sums.flat, sums.near,
        )  # fmt: skip
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
        """Of the offsets: each one's own : (n, m), and what they share : (n, m, 7)."""
        covariance = self.rest_covariance()
        half = np.linalg.cholesky((covariance + np.swapaxes(covariance, 1, 2)) / 2)
        shared = noise[:, None, None] * (self.mixed / self.information[..., None]) @ half
        return noise[:, None] / np.sqrt(self.information), shared

    def angles(self) -> Array:
        """Where along the outline the edges were seen : (n, m) rad."""
        sectors = self.offset.shape[1]
        return (np.arange(sectors) + 0.5) / sectors * 2 * np.pi - np.pi + self.turn / np.maximum(self.offset, 1e-12)


@njit
def _add_up(
    values, xy, normal, distance, angle, starts, levels, width, offset, limit,
    information, mixed, rest, toward_offset, toward_rest, turn, flat, near,
):  # fmt: skip
    """Fill the sums of `_Sums`: for each pixel measured less modelled, and the model's slopes.

    A plane `a + g t` that begins at t = 0, blurred by s, is `(a + g t) Phi(t/s) + g s phi(t/s)`.
    """
    sectors = offset.shape[1]
    columns = np.empty(SHARED)
    for i in range(len(starts) - 1):
        inner, outer, s = levels[i, :3], levels[i, 3:], width[i]
        for p in range(starts[i], starts[i + 1]):
            at = (angle[p] / (2 * np.pi) + 0.5) * sectors
            j = int(at) % sectors
            x, y = xy[p, 0], xy[p, 1]
            z = (distance[p] - offset[i, j]) / s
            share = 0.5 * math.erfc(-z / math.sqrt(2.0))
            peak = math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
            inside, outside = inner[0] + inner[1] * x + inner[2] * y, outer[0] + outer[1] * x + outer[2] * y
            bent_x, bent_y = s * peak * normal[p, 0], s * peak * normal[p, 1]
            bent = (outer[1] - inner[1]) * bent_x + (outer[2] - inner[2]) * bent_y
            residual = values[p] - inside - (outside - inside) * share - bent
            slope = -(outside - inside) * peak / s
            columns[0], columns[3] = 1 - share, share
            columns[1], columns[2] = x * (1 - share) - bent_x, y * (1 - share) - bent_y
            columns[4], columns[5] = x * share + bent_x, y * share + bent_y
            columns[6] = slope * z
            w = 1 / (1 + (residual / limit[i]) ** 2) ** 2
            information[i, j] += w * slope * slope
            toward_offset[i, j] += w * slope * residual
            turn[i, j] += w * slope * slope * (at - int(at) - 0.5) * 2 * np.pi / sectors
            for a in range(SHARED):
                mixed[i, j, a] += w * slope * columns[a]
                toward_rest[i, a] += w * columns[a] * residual
                for b in range(a + 1):
                    rest[i, a, b] += w * columns[a] * columns[b]
            near[i, 0] += w
            near[i, 1] += w * residual * residual
            if abs(z) > FLAT:
                flat[i, int(z > 0), 0] += w
                flat[i, int(z > 0), 1] += w * residual * residual
        for a in range(SHARED):
            for b in range(a):
                rest[i, b, a] = rest[i, a, b]


def _band(image: Array, outlines: Ellipses, reach: Array) -> _Band:
    height, width = image.shape
    extent = np.sqrt(np.einsum("nij,nij->ni", outlines.shape, outlines.shape)) + reach[:, None]
    low = np.clip(np.floor(outlines.centre - extent), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(outlines.centre + extent) + 1, 0, [width, height]).astype(int)
    parts = []
    for i, (centre, shape) in enumerate(zip(outlines.centre, outlines.shape, strict=True)):
        (left, top), (right, bottom) = low[i], high[i]
        v, u = np.mgrid[top:bottom, left:right]
        inverse = np.linalg.inv(shape)
        x, y = u - centre[0], v - centre[1]
        q = np.hypot(inverse[0, 0] * x + inverse[0, 1] * y, inverse[1, 0] * x + inverse[1, 1] * y)
        axes = np.linalg.eigvalsh(shape)
        near = np.abs(q - 1) * axes[0] < 1.5 * reach[i]  # the distance is at least that along the shorter axis
        pixels = np.column_stack([u[near], v[near]]).astype(float)
        distance, angle = signed_distance(pixels, centre, shape)
        keep = np.abs(distance) <= reach[i]
        values = image[top:bottom, left:right][near][keep]
        normal = on_ellipse(outlines[i : i + 1], angle[keep][None])[1][0]
        parts.append((values, (pixels[keep] - centre) / axes[1], normal / axes[1], distance[keep], angle[keep]))
    starts = np.concatenate([[0], np.cumsum([part[0].size for part in parts])]).astype(np.int64)
    values, xy, normal, distance, angle = (np.concatenate([part[k] for part in parts]) for k in range(5))
    return _Band(values.astype(float), xy, normal, distance, angle, starts)


def _first_levels(band: _Band, count: int) -> Array:
    """Planes of the inside and the outside : (n, 6), flat at first: the medians of the halves away from the edge."""
    levels = np.zeros((count, 6))
    for i in range(count):
        part = slice(band.starts[i], band.starts[i + 1])
        far = np.abs(band.distance[part]) > 0.4 * np.abs(band.distance[part]).max(initial=0)
        for column, side in ((0, band.distance[part] < 0), (3, band.distance[part] > 0)):
            if (far & side).any():
                levels[i, column] = np.median(band.values[part][far & side])
    return levels
