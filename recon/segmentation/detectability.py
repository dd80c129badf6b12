"""Probability that a mass of some size and contrast would have been found whole and measured, by how its place was seen.

An observer that averages over a body sees its contrast against what the mean scatters by: speckle, of which there are as many
independent cells as fit into the part of the body that was seen (Smith et al. 1983, *Low-contrast detectability and
contrast/detail analysis in medical ultrasound*; Wagner et al. 1983, *Statistics of speckle in ultrasound B-scans*), the
tissue's own unevenness, which doesn't average away within a lobule, and a noise of its own, however large the body (internal
noise). A body is measured if it is detected, larger than the blur, and seen as a whole. Each of the three is a psychometric
function, and the probability is their product, with that of a mass which nothing hides. `fit` finds the coefficients from
trials: one set for even tissue, where masses are found by their contrast, and another for grown tissue, where a network tells
them by their looks.
"""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.signal import fftconvolve
from scipy.special import expit, log_expit

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
    internal_db: float = 1.0  # its own noise, which no number of cells averages away; chosen by the trials that EVEN is fitted to
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


class Threshold(NamedTuple):
    """A logistic function of a feature."""

    middle: float  # where it is one half
    slope: float  # of its log odds


@dataclass(frozen=True)
class Calibration:
    """Coefficients: log odds of a mass that nothing hides, and thresholds that each feature has to pass."""

    dark: float
    bright: float
    detectability: Threshold  # of slope >= 0
    resolved: Threshold  # of slope >= 0
    unseen: Threshold  # of slope <= 0
    trials: int = 0  # that they were fitted to; 0 of assumed ones

    @property
    def coefficients(self) -> dict[str, float]:
        """By name."""
        thresholds = {name: getattr(self, name)._asdict() for name in Features._fields[:-1]}
        each = {f"{name}_{part}": value for name, parts in thresholds.items() for part, value in parts.items()}
        return {"dark": self.dark, "bright": self.bright} | each


EVEN = Calibration(7.27, -0.06, Threshold(1.249, 3.11), Threshold(1.269, 9.32), Threshold(0.0347, -50.6), trials=940)
"""Of masses that are found by their contrast; 39 silicone breasts, by a search that left out more bright ones, and
measured more that shadow."""
GROWN = Calibration(6.73, -5.68, Threshold(0.878, 10.6), Threshold(0.849, 4.71), Threshold(0.0249, -36.0), trials=572)
"""Of those that are found by their looks; 42 patients who keep still."""


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
    detectable = sought.contrast_db / np.sqrt(speckle + tissue + OBSERVER.internal_db**2)
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


def probability(given: Features, calibration: Calibration | None = None) -> Array:
    """Probability that a mass is found whole and measured; by default in even tissue."""
    chosen = calibration or EVEN
    chance = expit(np.where(np.asarray(given.bright) > 0, chosen.bright, chosen.dark))
    for name in Features._fields[:-1]:
        passed: Threshold = getattr(chosen, name)
        chance = chance * expit(passed.slope * (getattr(given, name) - passed.middle))
    return chance


def fit(given: Features, found: ArrayLike, ridge: float = 1e-3) -> Calibration:
    """Coefficients of the greatest likelihood, with slopes of signs by which a better view never harms.

    Parameters
    ----------
    given : (n,) each, of n trials
    found : (n,) bool, whether each mass was found whole and measured
    ridge : weight of the squares of what coefficients differ from usual ones by, in the features' standard deviations: keeps
        them finite where trials are parted

    Raises
    ------
    InputError
        If there are no more trials than coefficients, all were found or none, or arrays don't fit or aren't finite.
    """
    columns, hit = np.column_stack([np.ravel(one) for one in given]).astype(float), np.ravel(found).astype(bool)
    if len(hit) != len(columns) or not np.isfinite(columns).all():
        raise InputError(f"trials: expected finite features and whether each was found, found {columns.shape} and {len(hit)}")
    odds, middles, slopes = [2.0, 0.0], 3 * [-0.5], 3 * [3.0]  # usual ones: of dark and bright masses; towards better views
    usual = np.array([*odds, *middles, *slopes])
    if len(hit) <= len(usual) or hit.all() or not hit.any():
        raise InputError(f"trials: expected more than {len(usual)}, some found and some not, found {hit.sum()} of {len(hit)}")
    seen, bright, better = columns[:, :3], columns[:, 3] > 0, np.array([1, 1, -1])
    middle, scale = seen.mean(axis=0), np.where(seen.std(axis=0) > 0, seen.std(axis=0), 1) * better
    standard = (seen - middle) / scale

    def misfit(values: Array) -> tuple[float, Array]:
        odds, middles, slopes = values[:2], values[2:5], values[5:]
        away = standard - middles
        logits = np.column_stack([odds[bright.astype(int)], slopes * away])
        log_chance = log_expit(logits).sum(axis=1)
        log_missed = np.log(-np.expm1(np.minimum(log_chance, -1e-12)))
        by_log = np.where(hit, -1.0, np.exp(log_chance - log_missed))[:, None] * expit(-logits)  # slope by each logit
        by_odds = [by_log[bright == one, 0].sum() for one in (False, True)]
        slope = np.concatenate([by_odds, -(by_log[:, 1:] * slopes).sum(axis=0), (by_log[:, 1:] * away).sum(axis=0)])
        less = values - usual
        return float(-np.where(hit, log_chance, log_missed).sum() + ridge * less @ less), slope + 2 * ridge * less

    bounds = [*2 * ((-10.0, 10.0),), *3 * ((-6.0, 6.0),), *3 * ((0.0, 100.0),)]
    starts = [[*odds, *middles, *each] for each in product((2.0, 10.0), repeat=3)]  # likelihoods have several tops
    fits = [minimize(misfit, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 2000}) for start in starts]
    found_at = min(fits, key=lambda one: one.fun).x
    middles, slopes = (middle + scale * found_at[2:5]).tolist(), (found_at[5:] / scale).tolist()
    dark, bright_odds = found_at[:2].tolist()
    return Calibration(dark, bright_odds, *map(Threshold, middles, slopes), trials=len(hit))
