"""Ellipses as images of circles: their geometry, and their fit to edge points with the covariance of the centre.

An ellipse is `centre + shape @ u` over all unit vectors u, with `shape` symmetric and positive: its eigenvalues are the
semi-axes. Unlike axes and an angle, these five numbers stay smooth where the ellipse becomes a circle. All functions work on
many at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.geometry.order_statistics import NORMAL_MAD

Array = NDArray[np.float64]

STEPS = 12  # of Gauss and Newton; from a rough start three or four do
CAUTIOUS = 5  # of these with weights that find the majority first, so that no group of outliers bends the ellipse
CONVERGED = 1e-9  # px
TUKEY = 6.0  # standard deviations beyond which a point has no say; costs 2 % of efficiency if there are no outliers

KEPT = (1 - 6 / TUKEY**2 + 15 / TUKEY**4) / (1 - 2 / TUKEY**2 + 3 / TUKEY**4)  # of normal scatter's variance, so weighted


@dataclass(frozen=True)
class Ellipses:
    """n ellipses, px."""

    centre: Array  # (n, 2)
    shape: Array  # (n, 2, 2), symmetric and positive

    @property
    def semi_axes(self) -> Array:
        """The longer, then the shorter : (n, 2) px."""
        return np.linalg.eigvalsh(self.shape)[:, ::-1]

    def __getitem__(self, chosen) -> "Ellipses":
        return Ellipses(self.centre[chosen], self.shape[chosen])


def joined(parts: Sequence[Ellipses]) -> Ellipses:
    """Ellipses one after the other."""
    return Ellipses(np.concatenate([part.centre for part in parts]), np.concatenate([part.shape for part in parts]))


@dataclass(frozen=True)
class EllipseFit:
    """Fitted ellipses with their covariance."""

    ellipses: Ellipses
    covariance: Array  # (n, 5, 5) px^2, of the centre (x, y) and of the shape (xx, xy, yy)
    residuals: Array  # (n, m) px, of the points along the normals
    weights: Array  # (n, m), 1 for a good point, 0 for an outlier
    chi2: Array  # (n,) per degree of freedom: about 1 if the points scatter as their sigma says


def on_ellipse(ellipses: Ellipses, angles: Array) -> tuple[Array, Array]:
    """Points of the ellipses and their outward normals, both (n, m, 2), at the parameters `angles` : (n, m) of u."""
    u = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    gradient = u @ np.linalg.inv(ellipses.shape)
    points = ellipses.centre[:, None] + u @ ellipses.shape
    return points, gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)


def signed_distance(points: Array, centre: Array, shape: Array) -> tuple[Array, Array]:
    """Distance of points : (..., 2) from ellipses, positive outside, and the parameter of the point next to them, both (...).

    Centre : (..., 2) and shape : (..., 2, 2) broadcast. To second order in the distance: exact on the ellipse, and for circles.
    """
    inverse = np.linalg.inv(shape)
    a, b, c = inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]
    x, y = points[..., 0] - centre[..., 0], points[..., 1] - centre[..., 1]
    x = np.where((x == 0) & (y == 0), 1e-9, x)  # the centre itself is next to any point
    p, q = a * x + b * y, b * x + c * y  # on the unit circle
    radius = np.hypot(p, q)
    p, q = p / radius, q / radius
    slope_x, slope_y = a * p + b * q, b * p + c * q
    slope = np.hypot(slope_x, slope_y)
    bend = (p * (b * slope_x + c * slope_y) - q * (a * slope_x + b * slope_y)) ** 2 / (radius * slope**2)
    first = (radius - 1) / slope
    return first + bend * first**2 / (2 * slope), np.arctan2(q, p)


def from_outline(points: Array) -> Ellipses:
    """Ellipses through outlines : (n, m, 2) px of evenly spread points, from their second moments: a start for the fit."""
    centre = points.mean(axis=1)
    offsets = points - centre[:, None]
    return Ellipses(centre, root(2 * np.swapaxes(offsets, 1, 2) @ offsets / points.shape[1]))


def root(matrices: Array) -> Array:
    """Symmetric square roots of symmetric matrices : (n, 2, 2)."""
    values, vectors = np.linalg.eigh(matrices)
    return (vectors * np.sqrt(np.maximum(values, 1e-12))[:, None]) @ np.swapaxes(vectors, 1, 2)


def fit_ellipses(points: Array, sigma: Array, start: Ellipses, shared: Array | None = None) -> EllipseFit:
    """Fit an ellipse to each set of edge points, by least squares of the distances along the normals, robustly.

    Parameters
    ----------
    points : (n, m, 2) px
        Edge points. They may cover a part of the outline, if it is enough to tell an ellipse.
    sigma : (n, m) px
        Standard deviation of each point along the normal; inf leaves it out.
    start : Ellipses
        Rough ellipses, to a tenth of their size or so.
    shared : (n, m, k) px, optional
        Errors that the points of one ellipse have in common, as those of a misjudged brightness: k independent ones, each column
        what one standard deviation of it does to the points. They are estimated along.

    Returns
    -------
    EllipseFit
        The covariance follows from `sigma` and `shared` alone; where chi2 is well above 1 the points scatter more than these say.

    Source: Gauss-Newton on the orthogonal distance, reweighted: least absolute distances (Huber) first, then Tukey's weights.
    """
    shared = np.zeros((*sigma.shape, 0)) if shared is None else shared
    finite = np.isfinite(sigma) & np.isfinite(points).all(axis=-1)
    points, sigma = np.where(finite[..., None], points, (start.centre + start.shape[:, 0])[:, None]), np.where(finite, sigma, 1)
    weights = finite.astype(float)
    ellipses = start
    for k in range(STEPS):
        distance, design = _linearised(points, ellipses, shared)
        step, _ = _solve(design, distance, weights / sigma**2)
        explained = (design @ step[..., None])[..., 0]
        ellipses = _moved(ellipses, step)
        z = np.abs(distance - explained) / sigma
        weights = finite * (_tukey(z, finite) if k >= CAUTIOUS else 1 / np.maximum(z, 1))
        if k > CAUTIOUS and np.abs(step[:, :5]).max(initial=0) < CONVERGED:
            break
    distance, design = _linearised(points, ellipses, shared)
    step, inverse = _solve(design, distance, weights / sigma**2)
    residuals = distance - (design @ step[..., None])[..., 0]
    freedom = np.maximum(weights.sum(axis=1) - 5, 1)
    chi2 = (weights * (residuals / sigma) ** 2).sum(axis=1) / freedom / KEPT
    return EllipseFit(ellipses, inverse[:, :5, :5], np.where(finite, residuals, np.nan), weights, chi2)


def _linearised(points: Array, ellipses: Ellipses, shared: Array) -> tuple[Array, Array]:
    """Distances : (n, m), and their derivatives by the parameters and the shared errors : (n, m, 5 + k)."""
    distance, angles = signed_distance(points, ellipses.centre[:, None], ellipses.shape[:, None])
    _, normals = on_ellipse(ellipses, angles)
    x, y = normals[..., 0], normals[..., 1]
    c, s = np.cos(angles), np.sin(angles)
    return distance, np.concatenate([np.stack([x, y, x * c, x * s + y * c, y * s], axis=-1), shared], axis=-1)


def _solve(design: Array, values: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted least squares with a unit prior on the shared errors: the solution : (n, 5 + k) and the inverse normal matrix."""
    weighted = design * weights[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ design
    count = design.shape[-1]
    normal += np.diag((np.arange(count) >= 5).astype(float))
    trace = np.trace(normal[:, :5, :5], axis1=1, axis2=2)[:, None, None]
    normal += np.diag(np.arange(count) < 5) * (1e-12 * trace + 1e-30)  # an ellipse without points stays where it is
    inverse = np.linalg.inv(normal)
    return (inverse @ np.einsum("nmk,nm->nk", weighted, values)[..., None])[..., 0], inverse


def _moved(ellipses: Ellipses, step: Array) -> Ellipses:
    change = step[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    limit = 0.3 * ellipses.semi_axes[:, 1]  # stays an ellipse
    scale = np.minimum(1, limit / np.maximum(np.abs(step[:, :5]).max(axis=1), 1e-12))
    return Ellipses(ellipses.centre + scale[:, None] * step[:, :2], ellipses.shape + scale[:, None, None] * change)


def _tukey(z: Array, finite: NDArray[np.bool_]) -> Array:
    """Tukey's weights for absolute residuals over sigma; the scale is 1, or that of the residuals where they scatter more."""
    z_sorted = np.sort(np.where(finite | ~finite.any(axis=1, keepdims=True), z, np.nan), axis=1)  # NaN last
    count = (~np.isnan(z_sorted)).sum(axis=1)
    middle = np.maximum([(count - 1) // 2, count // 2], 0).T
    typical = np.take_along_axis(z_sorted, middle, axis=1).mean(axis=1)  # `numpy.nanmedian` takes ten times as long
    return np.clip(1 - (z / (TUKEY * np.maximum(1, NORMAL_MAD * typical)[:, None])) ** 2, 0, 1) ** 2
