"""The crossing of two wires in a B-scan: one spot in water, found to a fraction of a pixel, or the reason of its rejection.

In a log-compressed image a Gaussian spot is a paraboloid, so its top comes from a linear fit, which needs no start and stands
clipped pixels. Other echoes are rejected: reverberation at the probe's face (rows bright along the whole array), the tank's
bottom (drawn out), the wire's own comet tail and side lobes (below and beside, weaker), and the other wire's echo where the
crossing isn't in the image plane (a second spot, or a spot too wide).

The slice is thick, so an oblique wire is drawn out into a line: its parts beside the image plane lie at other depths. The
crossing is then an X, and its brightest point means nothing, for the wires' echoes interfere. But the lines still meet at the
crossing, seen along the image's normal, independent of their brightness; so two lines are fitted to the bright pixels. Of all
pairs of lines the one with fewest unexplained pixels is taken, where a pixel on both lines counts once: else two lines along one
wire would be the likeliest pair.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon import arguments
from recon.geometry.order_statistics import NORMAL_MAD

Array = NDArray[np.float64]

SEVERAL = "several candidates"  # reason of images as N-wires and other phantoms of many wires give
MATCHED_PX = (3.0, 1.5)  # along the array, in depth: smoothing before the search, somewhat narrower than a spot
APART_PX = (25, 13)  # no second candidate within half of this
CANDIDATES = 12  # the brightest looked at
CORE_DB = 8.0  # the spot's part that is fitted
OUTLINE_DB = 10.0  # the part of measured extent
NOISE = 6.0  # least height of an echo, in units of the noise
COLUMN_PX = 15.0  # reverberations of an echo lie below it within this
CLIPPED = 0.35  # share of the core that may be clipped
MIN_CORE = 12  # pixels, twice the unknowns
FLOOR_PX = 0.1  # no sighting counts as more exact than this
MAX_RIPPLE_DB = 1.0  # rms, of a spot about its paraboloid
MAX_OBLIQUE = 0.3  # correlation of a spot's width and height; oblique echoes are wires drawn out
FACE_PERCENT = 10  # of a row: its level there is the face's, even if a wire covers most of the row
ARMS_DB = 22.0  # below the brightest: range of the pixels that lines are fitted to
ARMS_PX = (70, 45)  # from the brightest, along the array and in depth
POINT_PX = np.array([2.6, 1.1])  # 1 sigma of a line's width along the array and in depth
DIRECTIONS = 12  # of the first look
STARTS = 6
STRAY = np.exp(-4.5)  # likelihood of a pixel on neither line, as at 3 sigma
MAX_SMOOTH = 0.45  # share of an echo's relief that a paraboloid explains: a bar or a blob has no arms
BORDER_PX = 4  # of the image, where lines may not meet
MIN_SINE = 0.15  # of the angle between the lines, in units of POINT_PX
SHARED_PX = 3.0  # pixels with one independent error of their place across the line, measured on simulated wires
MAX_ERROR_PX = (1.6, 1.2)  # 1 sigma of the meeting point; worse ones add little, and are often of a wrong line
DECIBEL = 20 / np.log(10)  # dB a neper of amplitude


@dataclass(frozen=True)
class Appearance:
    """Appearance of a crossing on a scanner."""

    dynamic_range_db: float = 60.0  # from black to white
    min_contrast_db: float = 9.0  # above the background
    rival_db: float = 6.0  # a second spot this much weaker, or less, makes the image ambiguous
    max_sigma_px: tuple[float, float] = (14.0, 7.0)  # of a spot, along the array and in depth (1.7 and 0.9 mm at 0.12 mm/px)
    max_extent_px: tuple[float, float] = (70.0, 40.0)  # of its outline; larger echoes are lines or surfaces
    top_px: int = 16  # rows at the probe's face that are left out


@dataclass(frozen=True)
class Crossing:
    """A crossing in an image, or the reason of its rejection."""

    pixel: Array  # (2,) u, v; NaN if there is none
    covariance: Array  # (2, 2) px^2
    contrast_db: float  # of the strongest echo above the background; NaN without any
    reason: str | None = None  # of the rejection
    directions: Array | None = None  # (2, 2) px, along the two lines; None of a spot

    @property
    def found(self) -> bool:
        """Whether there is a crossing."""
        return self.reason is None

    def shifted(self, corner: tuple[int, int]) -> "Crossing":
        """The same in an image of which this one is a part, from a pixel on."""
        return replace(self, pixel=self.pixel + corner)


def find(image: NDArray, appearance: Appearance | None = None) -> Crossing:
    """Find the crossing in a B-scan : (h, w), 8-bit grey levels, log-compressed. A spot, or else the meeting of two lines."""
    arguments.of_kind("appearance", appearance, Appearance, type(None))
    look = appearance or Appearance()
    level = np.asarray(arguments.numbers("image", image), np.float32)
    if level.ndim != 2 or min(level.shape) < 32:
        return _none(f"expected a grey image of at least 32x32 px, found shape {level.shape}")
    spot = _spot(level, look)
    if spot.found or (spot.reason or "").startswith(("no echo", "saturated", "too small")):
        return spot
    lines = _lines(level, look, spot.contrast_db)
    return lines if lines.found else spot


def _spot(level: NDArray[np.float32], look: Appearance) -> Crossing:
    grey = 255 / look.dynamic_range_db  # levels a dB
    smooth = cv2.GaussianBlur(level, (0, 0), sigmaX=MATCHED_PX[0], sigmaY=MATCHED_PX[1], borderType=cv2.BORDER_REPLICATE)
    relief = smooth - np.median(smooth, axis=1, keepdims=True)  # rows bright along the whole array are no spots
    noise = NORMAL_MAD * np.median(np.abs(relief - np.median(relief)))
    peaks = _peaks(relief, max(NOISE * noise, look.min_contrast_db * grey), look.top_px)
    if not len(peaks):
        return _none("no echo stands out")
    contrasts = relief[peaks[:, 1], peaks[:, 0]] / grey
    outlines = [_outline(smooth, peak, OUTLINE_DB * grey) for peak in peaks]
    extents = np.array([[np.ptp(columns) + 1, np.ptp(rows) + 1] for rows, columns in outlines])
    spots = (extents <= look.max_extent_px).all(axis=1)
    strongest = float(contrasts[0])
    if not spots.any():
        width, height = extents[0]
        return _none(f"only drawn-out echoes: the brightest covers {width:.0f}x{height:.0f} px", strongest)
    peaks, contrasts = peaks[spots], contrasts[spots]
    chosen, rivals = _first_arrival(peaks, contrasts, look.rival_db)
    if len(rivals):
        places = ", ".join(f"({u}, {v})" for u, v in (peaks[chosen], peaks[rivals[0]]))
        several = f"{SEVERAL}: {len(rivals) + 1} spots, such as at {places}"
        return _none(f"two candidates: {places}" if len(rivals) == 1 else several, float(contrasts[chosen]))
    return _fitted(level, smooth, peaks[chosen], float(contrasts[chosen]), grey, look)


def _peaks(relief: NDArray[np.float32], threshold: float, top: int) -> NDArray[np.int64]:
    """Local maxima : (n, 2) px u, v above a threshold, brightest first."""
    around = cv2.dilate(relief, np.ones((APART_PX[1], APART_PX[0]), np.uint8))
    v, u = np.nonzero((relief >= around) & (relief > threshold))
    order = np.argsort(-relief[v, u], kind="stable")
    order = order[v[order] >= top][:CANDIDATES]
    return np.column_stack([u[order], v[order]])


def _outline(smooth: NDArray[np.float32], peak: NDArray[np.int64], drop: float) -> tuple[NDArray, NDArray]:
    """Rows and columns of the connected part around a peak that is less than `drop` below it."""
    labels, _ = ndimage.label(smooth > smooth[peak[1], peak[0]] - drop)
    return np.nonzero(labels == labels[peak[1], peak[0]])


def _first_arrival(peaks: NDArray[np.int64], contrasts: Array, rival_db: float) -> tuple[int, NDArray[np.int64]]:
    """Number of the spot that is the wire's first echo, and numbers of its rivals. Echoes below it are its reverberations."""
    strong = np.flatnonzero(contrasts >= contrasts[0] - rival_db)
    beside = np.abs(peaks[:, 0] - peaks[0, 0]) <= COLUMN_PX
    chosen = int(min(strong[beside[strong]], key=lambda k: peaks[k, 1]))
    reverberations = (np.abs(peaks[:, 0] - peaks[chosen, 0]) <= COLUMN_PX) & (peaks[:, 1] >= peaks[chosen, 1])
    return chosen, strong[~reverberations[strong]]


def _fitted(level: Array, smooth: Array, peak: NDArray[np.int64], contrast: float, grey: float, look: Appearance) -> Crossing:
    """The top of the paraboloid through the spot's core."""
    rows, columns = _outline(smooth, peak, CORE_DB * grey)
    height, width = level.shape
    if rows.min() == 0 or columns.min() == 0 or rows.max() == height - 1 or columns.max() == width - 1:
        return _none("at the border", contrast)
    values = level[rows, columns].astype(float)
    clipped = values >= 254.5
    if clipped.mean() > CLIPPED:
        return _none(f"saturated: {100 * clipped.mean():.0f} % of the spot", contrast)
    x, y = columns[~clipped] - float(peak[0]), rows[~clipped] - float(peak[1])
    if len(x) < MIN_CORE:
        return _none(f"too small: {len(x)} px", contrast)
    design = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    solution = np.linalg.lstsq(design, values[~clipped], rcond=None)[0]
    gradient, hessian = solution[1:3], np.array([[2 * solution[3], solution[4]], [solution[4], 2 * solution[5]]])
    if np.linalg.eigvalsh(hessian).max() >= 0:
        return _none("no single top", contrast)
    top = -np.linalg.solve(hessian, gradient)
    if not (columns.min() < peak[0] + top[0] < columns.max() and rows.min() < peak[1] + top[1] < rows.max()):
        return _none("no single top", contrast)
    sigma = np.sqrt(np.diag(np.linalg.inv(-hessian)) * DECIBEL * grey)
    if (sigma > look.max_sigma_px).any():
        return _none(f"blurred: {sigma[0]:.1f}x{sigma[1]:.1f} px (1 sigma), the crossing isn't in the image plane", contrast)
    oblique = abs(hessian[0, 1]) / np.sqrt(hessian[0, 0] * hessian[1, 1])
    if oblique > MAX_OBLIQUE:
        return _none("an oblique echo", contrast)
    residual = np.zeros_like(level, float)
    residual[rows[~clipped], columns[~clipped]] = values[~clipped] - design @ solution
    if np.sqrt((residual**2).sum() / len(x)) > MAX_RIPPLE_DB * grey:
        return _none("no single top", contrast)
    variance = (residual**2).sum() / (len(x) - 6) * _correlation(residual)
    by_solution = -np.linalg.inv(hessian) @ np.column_stack(  # of the top
        [np.zeros(2), [1, 0], [0, 1], [2 * top[0], 0], [top[1], top[0]], [0, 2 * top[1]]]
    )
    covariance = by_solution @ np.linalg.inv(design.T @ design) @ by_solution.T * variance + FLOOR_PX**2 * np.eye(2)
    return Crossing(peak + top, covariance, contrast)


def _lines(level: NDArray[np.float32], look: Appearance, contrast: float) -> Crossing:
    """The meeting point of the two lines through the brightest echo."""
    points, weights, brightest = _arms(level, look)
    if len(points) < 4 * MIN_CORE:
        return _none("no arms", contrast)
    if _smoothness(points, weights) > MAX_SMOOTH:
        return _none("one smooth echo", contrast)
    middles, angles = _start(points, weights)
    middles, angles, shares, likelihood = _refined(points, weights, middles, angles)
    normals = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    meetings = np.einsum("sij,sj->si", np.linalg.pinv(normals), (normals * middles).sum(axis=-1))
    strong = points[weights > weights.max() - 14]
    apart = np.linalg.norm(strong - meetings[:, None], axis=-1).min(axis=1)
    good = (np.abs(np.sin(angles[:, 0] - angles[:, 1])) > MIN_SINE) & (apart < 2)
    if not good.any():
        return _none("only one line", contrast)
    best = np.where(good, likelihood, -np.inf).argmax()
    covariance = _meeting_covariance(points - meetings[best], shares[best] / weights.max(), angles[best])
    covariance = covariance * np.outer(POINT_PX, POINT_PX) + FLOOR_PX**2 * np.eye(2)
    pixel = brightest + meetings[best] * POINT_PX
    if (pixel < BORDER_PX).any() or (pixel > np.array(level.shape[::-1]) - 1 - BORDER_PX).any():
        return _none("at the border", contrast)
    sigma = np.sqrt(np.diag(covariance))
    if (sigma > MAX_ERROR_PX).any():
        return _none(f"lines too alike: they meet within {sigma[0]:.1f}x{sigma[1]:.1f} px (1 sigma)", contrast)
    along = np.stack([np.cos(angles[best]), np.sin(angles[best])], axis=-1) * POINT_PX
    return Crossing(pixel, covariance, contrast, directions=along / np.linalg.norm(along, axis=1, keepdims=True))


def _arms(level: NDArray[np.float32], look: Appearance) -> tuple[Array, Array, Array]:
    """Pixels : (n, 2) of the brightest echo, from its brightest in units of POINT_PX; dB above its edge; the brightest in px."""
    face = np.percentile(level, FACE_PERCENT, axis=1, keepdims=True)
    relief = (level - face) / (255 / look.dynamic_range_db)
    smooth = cv2.GaussianBlur(relief, (0, 0), sigmaX=MATCHED_PX[0], sigmaY=MATCHED_PX[1])
    smooth[: look.top_px] = 0
    v, u = np.unravel_index(smooth.argmax(), smooth.shape)
    background = np.median(smooth)
    noise = NORMAL_MAD * np.median(np.abs(smooth - background))
    drop = min(ARMS_DB, smooth[v, u] - background - NOISE * noise)
    if drop <= 0:
        return np.zeros((0, 2)), np.zeros(0), np.zeros(2)
    rows, columns = _outline(smooth, np.array([u, v]), drop)
    elsewhere = smooth.copy()
    elsewhere[rows, columns] = 0
    if elsewhere.max() > smooth[v, u] - look.rival_db:
        return np.zeros((0, 2)), np.zeros(0), np.zeros(2)  # another echo as bright
    above = relief[rows, columns] - smooth[v, u] + drop
    near = (np.abs(columns - u) < ARMS_PX[0]) & (np.abs(rows - v) < ARMS_PX[1]) & (above > 0) & (rows >= look.top_px)
    brightest = np.array([u, v], float)
    return (np.column_stack([columns, rows])[near] - brightest) / POINT_PX, above[near].astype(float), brightest


def _smoothness(points: Array, weights: Array) -> float:
    """Share of the variance of levels : (n,) dB at points : (n, 2) that a paraboloid explains."""
    x, y = points.T
    design = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    left = weights - design @ np.linalg.lstsq(design, weights, rcond=None)[0]
    return float(1 - (left**2).sum() / (((weights - weights.mean()) ** 2).sum() + 1e-9))


def _start(points: Array, weights: Array) -> tuple[Array, Array]:
    """Points : (s, 2, 2) on two lines and their angles : (s, 2), the likeliest of all pairs of directions at bright pixels."""
    strong = points[weights > weights.max() - 14]
    places, few = strong[:: max(1, len(strong) // 80)], slice(None, None, max(1, len(points) // 400))
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    normals = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    near = np.exp(-(np.einsum("pnj,aj->pan", points[few] - places[:, None], normals) ** 2) / 2)
    first, second = np.triu_indices(DIRECTIONS, 1)
    pairs = zip(first, second, strict=True)
    likelihood = np.stack(
        [np.log(near[:, a] + near[:, b] - near[:, a] * near[:, b] + STRAY) @ weights[few] for a, b in pairs], axis=1
    )
    best = np.argsort(-likelihood.max(axis=0))[:STARTS]
    middles = np.repeat(places[likelihood[:, best].argmax(axis=0)][:, None], 2, axis=1)
    return middles, np.column_stack([angles[first[best]], angles[second[best]]])


def _refined(points: Array, weights: Array, middles: Array, angles: Array) -> tuple[Array, Array, Array, Array]:
    """Expectation and maximisation: each pixel is shared between the lines, then each line is fitted across its width."""
    for _ in range(20):
        normals = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
        distances = np.einsum("skj,nj->skn", normals, points) - (normals * middles).sum(axis=-1)[..., None]
        near = np.exp(-np.minimum(distances**2, 60) / 2)
        shares = near / (near.sum(axis=1) + STRAY)[:, None] * weights
        mass = shares.sum(axis=-1) + 1e-9
        middles = np.einsum("skn,nj->skj", shares, points) / mass[..., None]
        spread = np.einsum("skn,ni,nj->skij", shares, points, points) / mass[..., None, None]
        spread -= middles[..., :, None] * middles[..., None, :]
        angles = np.arctan2(2 * spread[..., 0, 1], spread[..., 0, 0] - spread[..., 1, 1]) / 2
    return middles, angles, shares, np.log(near.sum(axis=1) - near.prod(axis=1) + STRAY) @ weights


def _meeting_covariance(offsets: Array, shares: Array, angles: Array) -> Array:
    """Covariance : (2, 2) of the meeting point of two lines, from pixels at offsets : (n, 2) from it, shared out as (2, n)."""
    information, squares = 1e-9 * np.eye(4), 0.0
    for line, angle in enumerate(angles):
        across = np.array([-np.sin(angle), np.cos(angle)])
        design = np.zeros((len(offsets), 4))
        design[:, :2], design[:, 2 + line] = across, -offsets @ [np.cos(angle), np.sin(angle)]
        information += design.T @ (design * shares[line][:, None])
        squares += (shares[line] * (offsets @ across) ** 2).sum()
    return np.linalg.inv(information)[:2, :2] * squares / shares.sum() * SHARED_PX


def _correlation(residual: Array) -> float:
    """Number of pixels with one independent error in common, from the correlation of neighbours along both axes."""
    power = (residual**2).sum() + 1e-12
    along = (residual[:, 1:] * residual[:, :-1]).sum() / power, (residual[1:] * residual[:-1]).sum() / power
    return float(np.prod([(1 + rho) / (1 - rho) for rho in np.clip(along, 0, 0.9)]))


def _none(reason: str, contrast: float = np.nan) -> Crossing:
    return Crossing(np.full(2, np.nan), np.full((2, 2), np.nan), contrast, reason)
