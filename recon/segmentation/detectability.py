"""Probability that a mass of some size and contrast would have been found whole and measured, by how its place was seen.

An observer that averages over a body sees its contrast against what the mean scatters by: speckle, of which there are as many
independent cells as fit into the part of the body that was seen (Smith et al. 1983, *Low-contrast detectability and
contrast/detail analysis in medical ultrasound*; Wagner et al. 1983, *Statistics of speckle in ultrasound B-scans*), and the
tissue's own unevenness, which doesn't average away within a lobule. A body is measured if all of it was seen, and if it is
larger than the blur. A logistic function of these features makes a probability of them, with coefficients that `fit` finds from
trials: one set for even tissue, where masses are found by their contrast, and another for grown tissue, where a network tells
them by their looks.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.signal import fftconvolve
from scipy.special import expit

from recon import arguments
from recon.errors import InputError
from recon.geometry import rigid
from recon.segmentation.insonation import Insonation, world_from_voxel
from recon.segmentation.mass_network import Looks

Array = NDArray[np.float64]
Map = NDArray[np.float32]


@dataclass(frozen=True)
class Observer:
    """What limits whoever looks for a mass."""

    speckle_db: float = 5.57  # standard deviation of log-compressed speckle: 10/ln 10 * pi/sqrt(6)
    patch_mm: float = 3.0  # of tissue, within which its unevenness doesn't average away: lobules; assumed
    even_db: float = 0.8  # unevenness of even tissue, where it isn't known; of silicone
    least: float = 0.05  # of detectability, and of a size over the blur: below all are alike
    width: float = 2 * float(np.sqrt(2 * np.log(2)))  # of a blur at half its height, over its standard deviation


OBSERVER = Observer()


@dataclass(frozen=True)
class Sought:
    """A mass that may be there: a ball."""

    size_mm: float = 8.0  # diameter
    contrast_db: float = 8.0  # by which it is darker than the tissue
    bright: bool = False  # brighter, instead


class Features(NamedTuple):
    """What the probability depends on, each of one shape."""

    detectability: Array  # ln d', the contrast over the scatter of the body's mean
    resolved: Array  # ln of the size over the full width at half maximum of the coarsest blur at the middle
    unseen: Array  # share of the ball that wasn't seen
    bright: Array  # 1 of a mass that is brighter than the tissue, else 0


@dataclass(frozen=True)
class Calibration:
    """Coefficients of the features' sum, whose logistic function is the probability."""

    constant: float = -9.5
    detectability: float = 3.0  # >= 0
    resolved: float = 1.5  # >= 0
    unseen: float = -25.0  # <= 0: with a tenth unseen a body counts as cut
    bright: float = -1.0
    trials: int = 0  # that they were fitted to; 0 of assumed ones

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The constant, and a coefficient a feature."""
        return self.constant, self.detectability, self.resolved, self.unseen, self.bright


EVEN, GROWN = Calibration(), Calibration()  # of masses that are found by their contrast, and by their looks
BOUNDS = ((None, None), (0, None), (0, None), (None, 0), (None, None))  # of the coefficients: a better view never harms


class Ball(NamedTuple):
    """Means over a ball about each place: (nz, ny, nx), or (n,) of some."""

    seen: Array  # share
    cells: Array  # independent cells of speckle a mm^3


def ball_weights(size_mm: float, spacing: Array) -> Map:
    """Share : (nz, ny, nx) of a ball in each voxel around its middle one, of a sum of 1; spacing : (3,) mm, x, y, z."""
    parts = 5  # of a voxel, along each axis
    axes = []
    for step in spacing[::-1]:
        reach = int(np.ceil(size_mm / 2 / step - 0.5 + 1e-9))
        axes.append(((np.arange((2 * max(reach, 0) + 1) * parts) + 0.5) / parts - max(reach, 0) - 0.5) * step)
    z, y, x = np.meshgrid(*axes, indexing="ij", sparse=True)
    inside = z**2 + y**2 + x**2 <= (size_mm / 2) ** 2
    blocks = inside.reshape([n for axis in axes for n in (len(axis) // parts, parts)]).sum(axis=(1, 3, 5)).astype(np.float32)
    if not blocks.any():
        blocks[tuple(n // 2 for n in blocks.shape)] = 1
    return blocks / blocks.sum()


def ball_means(where: Insonation, size_mm: float) -> Ball:
    """Share seen and density of speckle's cells in a ball about each voxel; nothing is seen beyond the grid."""
    weights = ball_weights(size_mm, where.grid.spacing)
    seen, cells = (np.maximum(fftconvolve(one, weights, mode="same"), 0) for one in (where.seen, where.cells))
    return Ball(np.minimum(seen, 1), cells)


def features(ball: Ball, elevational_mm: ArrayLike, sought: Sought, uneven_db: ArrayLike = OBSERVER.even_db) -> Features:
    """Features of a mass with its middle at places.

    Parameters
    ----------
    ball : of the mass's size about these
    elevational_mm : sigma of the coarsest blur there
    uneven_db : standard deviation of the tissue's power, as of `recon.segmentation.masses.from_scans`; NaN counts as even tissue
    """
    volume = np.pi / 6 * sought.size_mm**3
    uneven = np.where(np.isnan(uneven_db), OBSERVER.even_db, uneven_db)
    with np.errstate(divide="ignore"):
        speckle = OBSERVER.speckle_db**2 / (np.asarray(ball.cells, float) * volume)
    tissue = uneven**2 / max(1.0, volume / OBSERVER.patch_mm**3)
    detectable = sought.contrast_db / np.sqrt(speckle + tissue)
    resolved = sought.size_mm / (OBSERVER.width * np.maximum(elevational_mm, 1e-6))
    low, shape = OBSERVER.least, np.shape(detectable)
    return Features(
        np.log(np.maximum(detectable, low)),
        np.broadcast_to(np.log(np.maximum(resolved, low)), shape),
        1 - np.asarray(ball.seen, float),
        np.full(shape, float(sought.bright)),
    )


def features_at(
    where: Insonation,
    places: Array,
    size_mm: ArrayLike,
    contrast_db: ArrayLike,
    bright: ArrayLike = False,
    uneven_db: ArrayLike = OBSERVER.even_db,
) -> Features:
    """Features : (n,) of masses in a sweep, such as those of trials.

    Parameters
    ----------
    places : (n, 3) mm in the world, the masses' middles; those beyond the grid are unseen
    size_mm, contrast_db, bright : (n,), or one for all
        Diameters of balls of the same volume, differences from the tissue, and whether they are brighter than it.
    uneven_db : of the tissue, (n,) or one

    Raises
    ------
    InputError
        If arrays have other shapes or aren't finite.
    """
    places = arguments.numbers("places", places, ("n", 3))
    count = len(places)
    sizes, contrasts, uneven = (np.broadcast_to(np.asarray(one, float), count) for one in (size_mm, contrast_db, uneven_db))
    brighter = np.broadcast_to(np.asarray(bright, bool), count)
    if not ((sizes > 0) & (contrasts >= 0)).all():
        raise InputError("masses: expected sizes above 0 mm and contrasts of 0 dB or more, found others")
    voxel_from_world = np.linalg.inv(world_from_voxel(where.grid))
    index = np.rint(rigid.apply(voxel_from_world, places)).astype(int)
    size = np.array(where.grid.size)
    there = ((index >= 0) & (index < size)).all(axis=1)
    i, j, k = np.clip(index, 0, size - 1).T
    blur = np.where(there, where.elevational_mm[k, j, i], np.inf)
    made = np.zeros((4, count))
    for one in np.unique(sizes):
        whole = ball_means(where, float(one))
        seen, cells = (np.where(there, field[k, j, i], 0) for field in whole)
        for n in np.flatnonzero(sizes == one):
            sought = Sought(float(one), float(contrasts[n]), bool(brighter[n]))
            made[:, n] = features(Ball(seen[n], cells[n]), blur[n], sought, uneven[n])
    return Features(*made)


def calibration_for(uneven_db: float, looks: Looks | None = None) -> Calibration:
    """Coefficients of the observer that looks for masses in tissue whose power has a standard deviation."""
    return GROWN if (looks or Looks()).sees(uneven_db) else EVEN


def source(trials: int) -> str:
    """Origin of coefficients, for people."""
    return f"by coefficients fitted to {trials} trials" if trials else "by assumed coefficients"


def probability(given: Features, calibration: Calibration = EVEN) -> Array:
    """Probability that a mass is found whole and measured."""
    constant, *slopes = calibration.coefficients
    return expit(constant + sum(slope * one for slope, one in zip(slopes, given, strict=True)))


def fit(given: Features, found: ArrayLike, ridge: float = 1e-3) -> Calibration:
    """Coefficients by logistic regression: those of the greatest likelihood, of signs by which a better view never harms.

    Parameters
    ----------
    given : (n,) each, of n trials
    found : (n,) bool, whether each mass was found whole and measured
    ridge : weight of the squares of the slopes, over the features' standard deviations: keeps them finite where trials are parted

    Raises
    ------
    InputError
        If there are fewer trials than coefficients, all were found or none, or arrays don't fit or aren't finite.
    """
    columns, hit = np.column_stack([np.ravel(one) for one in given]).astype(float), np.ravel(found).astype(bool)
    if len(hit) != len(columns) or not np.isfinite(columns).all():
        raise InputError(f"trials: expected finite features and whether each was found, found {columns.shape} and {len(hit)}")
    if len(hit) <= columns.shape[1] or hit.all() or not hit.any():
        raise InputError(
            f"trials: expected more than {columns.shape[1]}, some found and some not, found {hit.sum()} of {len(hit)}"
        )
    scale = columns.std(axis=0)
    used = scale > 0
    middle, scale = np.where(used, columns.mean(axis=0), 0), np.where(used, scale, 1)
    design = np.column_stack([np.ones(len(hit)), (columns - middle) / scale * used])
    sign = np.where(hit, 1.0, -1.0)

    def misfit(slopes: Array) -> tuple[float, Array]:
        logit = sign * (design @ slopes)
        weight = 2 * ridge * np.append(0, slopes[1:])
        return np.logaddexp(0, -logit).sum() + ridge * float(slopes[1:] @ slopes[1:]), weight - design.T @ (sign * expit(-logit))

    found_at = minimize(misfit, np.zeros(design.shape[1]), jac=True, method="L-BFGS-B", bounds=BOUNDS, options={"maxiter": 2000})
    slopes = found_at.x[1:] / scale * used
    return Calibration(float(found_at.x[0] - slopes @ middle), *slopes.tolist(), trials=len(hit))
