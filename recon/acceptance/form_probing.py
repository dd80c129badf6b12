"""Spheres and planes fitted to measured points, with uncertainties that neighbouring points' common errors don't deceive.

Points of a camera share errors with their neighbours, by the optics' blur and filters, so that a fit's usual covariance is too
small. Here the points' cells, a hundredth of the surface each, are what is independent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon.geometry.primitives import Fit, Plane, Sphere, fit_plane, fit_sphere

Array = NDArray[np.float64]
Kind = TypeVar("Kind", Plane, Sphere)

CELLS = 10  # along each side of the surface
REPEATS = 200  # of noise drawn anew
ALL, MOST = 0.997, 0.95  # shares of the points that the shells hold: VDI/VDE 2634 lets 3 in 1000 go; ISO 10360-13's D95%
TREND = 3  # degree of the polynomial that is the surface's systematic form
LEAST_VARIANCE = 0.1  # of the mean one, of noise anywhere


class Width(NamedTuple):
    """Width of the narrowest shell around a share of the points."""

    mm: float
    sigma_mm: float  # standard deviation, by another set of points with other noise


@dataclass(frozen=True, eq=False)
class Probed(Generic[Kind]):
    """A shape fitted to all points, and how far these are from it."""

    shape: Kind
    residuals: Array  # (n,) mm
    covariance: Array  # of the sphere's centre and radius, or as of `fit_plane`
    freedom: float  # degrees of freedom of the covariance
    all: Width
    most: Width


def probe_sphere(points: Array, rng: np.random.Generator, repeats: int = REPEATS) -> Probed[Sphere]:
    """Fit a sphere of free radius to points : (n, 3) mm; raises ValueError as `fit_sphere`."""
    fit = fit_sphere(points)
    away = points - fit.shape.centre
    outwards = away / np.linalg.norm(away, axis=1, keepdims=True)
    return _probed(fit, points, outwards.mean(axis=0), np.column_stack([-outwards, -np.ones(len(points))]), rng, repeats)


def probe_plane(points: Array, rng: np.random.Generator, repeats: int = REPEATS) -> Probed[Plane]:
    """Fit a plane to points : (n, 3) mm; raises ValueError as `fit_plane`."""
    fit = fit_plane(points)
    across = _across(points, fit.shape.normal)
    return _probed(fit, points, fit.shape.normal, np.column_stack([across, -np.ones(len(points))]), rng, repeats)


def shell_width(residuals: Array, share: float) -> Array:
    """Width : (...) of the narrowest interval that holds a share of residuals : (..., n), whose mean needn't be zero.

    It is the range of all residuals where the share is 1. Its expectation grows with the number of points, slowly for a share
    below 1.
    """
    ordered = np.sort(residuals, axis=-1)
    count = ordered.shape[-1]
    held = max(2, int(np.ceil(share * count)))
    return (ordered[..., held - 1 :] - ordered[..., : count - held + 1]).min(axis=-1)


def _probed(
    fit: Fit[Kind], points: Array, normal: Array, jacobian: Array, rng: np.random.Generator, repeats: int
) -> Probed[Kind]:
    across = _across(points, normal / np.linalg.norm(normal))
    cells = _cells(across)
    covariance, freedom = _clustered(jacobian, fit.residuals, cells)
    draw = _redrawn(fit.residuals, across, cells)
    again = draw(rng, repeats)
    widths = [Width(float(shell_width(fit.residuals, s)), float(shell_width(again, s).std())) for s in (ALL, MOST)]
    return Probed(fit.shape, fit.residuals, covariance, freedom, *widths)


def _across(points: Array, normal: Array) -> Array:
    """Places : (n, 2) mm of points in the plane across a unit normal, about their middle."""
    _, _, directions = np.linalg.svd(normal[None])
    return (points - points.mean(axis=0)) @ directions[1:].T


def _cells(across: Array) -> NDArray[np.intp]:
    """Numbers : (n,) from 0 of the cells in which places : (n, 2) lie."""
    low, high = across.min(axis=0), across.max(axis=0)
    place = np.minimum((CELLS * (across - low) / (high - low)).astype(int), CELLS - 1)
    return np.unique(place @ [CELLS, 1], return_inverse=True)[1]


def _clustered(jacobian: Array, residuals: Array, cells: NDArray[np.intp]) -> tuple[Array, float]:
    """Covariance of least squares whose residuals are independent from cell to cell only, and its degrees of freedom.

    Source: Bell and McCaffrey 2002 (CR2): residuals of a cell are enlarged by `(I - H)^(-1/2)`, so that the covariance is
    unbiased where they are independent. Here carried to the parameters, where the matrices are small.
    """
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    count, parameters = cells.max() + 1, jacobian.shape[1]
    squares, pulls = np.zeros((count, parameters, parameters)), np.zeros((count, parameters))
    np.add.at(squares, cells, jacobian[:, :, None] * jacobian[:, None, :])
    np.add.at(pulls, cells, jacobian * residuals[:, None])
    values, vectors = np.linalg.eigh(inverse)
    root, unroot = (vectors * values**power @ vectors.T for power in (0.5, -0.5))
    held, turned = np.linalg.eigh(np.eye(parameters) - root @ squares @ root)
    enlarged = np.einsum("cij,cj,ckj,ck->ci", turned, np.maximum(held, 1e-3) ** -0.5, turned, pulls @ root)
    pulls = enlarged @ unroot
    return inverse @ (pulls.T @ pulls) @ inverse, float(max(count - parameters, 1))


def _redrawn(residuals: Array, across: Array, cells: NDArray[np.intp]) -> Callable[[np.random.Generator, int], Array]:
    """A function that draws residuals anew : (repeats, m), of the m points that are independent of each other.

    The surface's smooth form stays, the rest is normal, with a variance that changes smoothly over the surface, and with as many
    points that count as one as cells' means scatter more than those of independent points. A bootstrap of the rest itself would
    not do: extremes have none (Efron and Tibshirani 1993, 7.4).
    """
    x, y = (across / np.abs(across).max(axis=0)).T
    terms = np.stack([x**i * y**j for i in range(TREND + 1) for j in range(TREND + 1 - i)], axis=1)
    form = terms @ np.linalg.lstsq(terms, residuals, rcond=None)[0]
    rest, counts = residuals - form, np.bincount(cells)
    even = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    variance = even @ np.linalg.lstsq(even, rest**2, rcond=None)[0]
    sigma = np.sqrt(np.maximum(variance, LEAST_VARIANCE * np.mean(rest**2)))
    means = np.bincount(cells, rest / sigma) / np.sqrt(counts)
    alike = float(np.sum(means**2)) / max(len(counts) - terms.shape[1], 1)  # points that count as one
    some = np.argsort(cells, kind="stable")[:: max(1, round(alike))]

    def draw(rng: np.random.Generator, repeats: int) -> Array:
        return form[some] + sigma[some] * rng.standard_normal((repeats, len(some)))

    return draw
