"""The wall of a round tube or rod in a B-scan through water, to a fraction of a pixel, and the cylinder through many of them.

Only the front half of the wall is measured: it is bright where it is square to the beam, weaker towards the sides, and echoes
from behind it are shown at wrong depths, for sound has another speed inside. A wall's echo has its middle on the wall, since
pulse and beam are symmetric; so the edge is the middle of the echo across the wall, between two equal levels, which stands
clipped pixels. Two things move it. The bend of the wall: of a circle of radius R blurred by sigma along the wall, the ridge lies
at `R - sigma²/(2 R)`. And its fading towards the sides: the beam is wider than the pulse is deep, so a bright crest smears beyond
the wall beside it. A wall whose power grows as `exp(g s)` along its tangent t, blurred by a Gaussian of covariance S, has its
ridge `-g t.S n` off along its normal n.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from recon.errors import InputError
from recon.estimation.covariance import propagate
from recon.geometry import rigid
from recon.geometry.order_statistics import NORMAL_MAD
from recon.geometry.primitives import Cylinder, fit_cylinder
from recon.model.probe import ProbeCalibration
from recon.segmentation.echo_power import SPREAD_MM

Array = NDArray[np.float64]

LEAST_EDGES = 40
FLOOR_MM = 0.01  # no edge counts as more exact than this


@dataclass(frozen=True)
class Appearance:
    """Appearance of a tube on a scanner."""

    diameter_mm: tuple[float, float] = (5.0, 36.0)  # least and most
    spread_mm: tuple[float, float] = SPREAD_MM  # sigma of an echo's power, along the array and in depth
    dynamic_range_db: float = 60.0  # from black to white
    min_contrast_db: float = 15.0  # of the wall above the water
    top_mm: float = 2.5  # ringing at the probe's face, left out


@dataclass(frozen=True)
class Ring:
    """Edge points of a tube's wall in an image, or the reason of their absence."""

    pixels: Array  # (n, 2) u, v
    covariance: Array  # (n, 2, 2) px^2
    reason: str | None = None

    @property
    def found(self) -> bool:
        """Whether there is a ring."""
        return self.reason is None


@dataclass(frozen=True)
class Tube:
    """A cylinder through the rings of many images."""

    shape: Cylinder
    sigma_mm: float  # standard deviation of the radius, images being independent
    residuals: Array  # (n,) mm, positive outside
    frames: NDArray[np.int64]  # (n,) the number of each residual's image

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, mm."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def find(image: NDArray, scale: Array, appearance: Appearance | None = None) -> Ring:
    """Find a tube's wall.

    Parameters
    ----------
    image : (h, w), 8-bit grey levels, log-compressed
    scale : (2,) mm/px along u and v, calibrated in the water of the images
    """
    look = appearance or Appearance()
    level, scale = np.asarray(image, np.float32), np.asarray(scale, float)
    if level.ndim != 2 or min(level.shape) < 32:
        return _none(f"expected a grey image of at least 32x32 px, found shape {level.shape}")
    grey = 255 / look.dynamic_range_db  # levels a dB
    first = _first_echoes(level, int(np.ceil(look.top_mm / scale[1])), look.min_contrast_db * grey) * scale
    if len(first) < 10:
        return _none("no echo stands out")
    circle, near = _rough_circle(first, look.diameter_mm)
    if near is None:
        return _none(f"no arc of {look.diameter_mm[0]:g} to {look.diameter_mm[1]:g} mm in diameter")
    directions = np.arctan2(first[near, 0] - circle[0], circle[1] - first[near, 1])
    least_arc_deg = 70.0  # of first echoes; less leaves the radius to chance
    if np.ptp(directions) < np.deg2rad(least_arc_deg):
        return _none(f"an arc of {np.rad2deg(np.ptp(directions)):.0f} deg, expected at least {least_arc_deg:.0f}")
    ring = _measure(level, scale, circle, look, grey)
    centrings = 3
    for _ in range(centrings):  # first echoes lie outside of a wide beam's ridge, and rays have to meet the wall square
        refined = _algebraic(ring.pixels * scale) if ring.found else None
        if refined is None:
            return ring
        circle = refined
        ring = _measure(level, scale, circle, look, grey)
    if not look.diameter_mm[0] <= 2 * circle[2] <= look.diameter_mm[1]:
        return _none(f"a diameter of {2 * circle[2]:.1f} mm, expected {look.diameter_mm[0]:g} to {look.diameter_mm[1]:g}")
    return ring


def fit_tube(rings: Sequence[Ring], world_from_pixel: Array) -> Tube:
    """Fit a cylinder to the rings of many images, each point weighed by its uncertainty across the wall.

    Parameters
    ----------
    rings : n of them
        Those that weren't found are left out.
    world_from_pixel : (n, 4, 4)
        Takes [u, v, 0, 1] to mm in the world; images with a NaN are left out.

    Raises
    ------
    InputError
        If fewer than three images are left, or their number isn't that of the poses.
    """
    if len(rings) != len(world_from_pixel):
        raise InputError(f"rings: expected as many as poses, {len(world_from_pixel)}, found {len(rings)}")
    used = [k for k, ring in enumerate(rings) if ring.found and np.isfinite(world_from_pixel[k]).all()]
    if len(used) < 3:
        raise InputError(f"rings: expected at least three images that show the tube, found {len(used)}")
    points = np.concatenate([in_world(rings[k].pixels, world_from_pixel[k]) for k in used])
    frames = np.concatenate([np.full(len(rings[k].pixels), k) for k in used])
    covariance = np.concatenate([_turned(rings[k].covariance, world_from_pixel[k]) for k in used])
    return _weigh(points, covariance, frames)


def scale_sigma(rings: Sequence[Ring], world_from_pixel: Array, tube: Tube, probe: ProbeCalibration) -> float:
    """Standard deviation of a tube's radius, mm, due to those of sx and sy, common to all images; 0 if none is known."""
    known = probe.uncertainty
    if known is None:
        return 0.0
    names = [name for name in ("sx", "sy") if known.sigma(name) > 0]
    slopes = []
    for name in names:
        k, sigma = ("sx", "sy").index(name), known.sigma(name)
        changed = np.ones(4)
        changed[k] += sigma / probe.scale[k]
        slopes.append((fit_tube(rings, world_from_pixel * changed).shape.radius - tube.shape.radius) / sigma)
    order = [known.names.index(name) for name in names]
    return float(np.sqrt(np.array(slopes) @ known.covariance[np.ix_(order, order)] @ np.array(slopes))) if names else 0.0


def in_world(pixels: Array, world_from_pixel: Array) -> Array:
    """Pixels : (n, 2) u, v of an image, to points : (n, 3) mm."""
    return rigid.apply(world_from_pixel, np.column_stack([pixels, np.zeros(len(pixels))]))


def _first_echoes(level: NDArray[np.float32], top: int, contrast: float) -> Array:
    """The first echo of each column that has one : (n, 2) px u, v, to half a pixel.

    `contrast` is in grey levels, above the column's background; rows above `top` are left out.
    """
    smooth_px = 1.0  # before the first echo of each column is looked for
    smooth = cv2.GaussianBlur(level, (0, 0), smooth_px, borderType=cv2.BORDER_REPLICATE)[top:]
    background = np.median(smooth, axis=1, keepdims=True)  # rows bright along the whole array are no wall
    bright = smooth - background > contrast
    peak = bright & (smooth >= np.roll(smooth, -1, axis=0)) & (smooth >= np.roll(smooth, 1, axis=0))
    peak[[0, -1]] = False
    columns = np.flatnonzero(peak.any(axis=0))
    return np.column_stack([columns, top + peak[:, columns].argmax(axis=0)]).astype(float)


def _rough_circle(points: Array, diameter: tuple[float, float]) -> tuple[Array, NDArray[np.bool_] | None]:
    """Circle x, y, radius with most of the points on its front side, and these points; None without one of the size."""
    seed = 0  # of the trials: the same image gives the same ring
    rng = np.random.default_rng(seed)
    best, chosen, count = np.zeros(3), None, 9
    trials = 400  # circles through three first echoes
    for _ in range(trials):
        three = points[rng.choice(len(points), 3, replace=False)]
        circle = _algebraic(three)
        if circle is None or not diameter[0] <= 2 * circle[2] <= diameter[1]:
            continue
        near = _on_front(points, circle)
        if near.sum() > count:
            best, chosen, count = circle, near, int(near.sum())
    if chosen is not None:
        refined = _algebraic(points[chosen])
        if refined is not None and diameter[0] <= 2 * refined[2] <= diameter[1]:
            best, chosen = refined, _on_front(points, refined)
    return best, chosen


def _on_front(points: Array, circle: Array) -> NDArray[np.bool_]:
    away = points - circle[:2]
    near_mm = 0.5  # from a circle, of the first echoes that count for it
    return (np.abs(np.hypot(*away.T) - circle[2]) < near_mm) & (away[:, 1] < near_mm)


def _algebraic(points: Array) -> Array | None:
    system = np.column_stack([2 * points, np.ones(len(points))])
    solution, _, rank, _ = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=1e-9)
    square = solution[2] + solution[0] ** 2 + solution[1] ** 2
    return np.array([solution[0], solution[1], np.sqrt(square)]) if rank == 3 and square > 0 else None


def _measure(level: NDArray[np.float32], scale: Array, circle: Array, look: Appearance, grey: float) -> Ring:
    """Edges along rays from the rough centre, less those off a smooth outline, with their scatter about it."""
    step_deg = 1.0  # between rays
    half_arc_deg = 85.0  # of rays, on either side of the wall's front
    angle = np.deg2rad(np.arange(-half_arc_deg, half_arc_deg + step_deg / 2, step_deg))
    rays = np.column_stack([np.sin(angle), -np.cos(angle)])
    window_spreads = 3.0  # times the spread along the array
    window_mm = 1.2  # along a ray, on either side of the rough circle, and
    window = window_mm + window_spreads * look.spread_mm[0]
    sample_mm = 0.02
    along = np.arange(max(circle[2] - window, 0.3 * circle[2]), circle[2] + window, sample_mm)
    places = (circle[:2] + rays[:, None] * along[:, None]) / scale
    profiles = map_coordinates(level, [places[..., 1], places[..., 0]], order=1, mode="constant", cval=0.0)
    height, width = level.shape
    inside = ((places >= 0) & (places <= [width - 1, height - 1])).all(axis=(1, 2)) & (
        places[..., 1].min(axis=1) * scale[1] > 1.0
    )
    edge_db = 10.0  # below the echo's top, where its two edges are taken
    middle, extent = _echo_middles(profiles, edge_db * grey, look.min_contrast_db * grey)
    good = inside & np.isfinite(middle)
    if good.sum() < LEAST_EDGES:
        return _none(f"too few edges: {good.sum()} of {len(angle)} rays")
    angle, rays = angle[good], rays[good]
    radius, extent = along[0] + sample_mm * middle[good], sample_mm * extent[good]
    outline, scatter = _smooth_outline(angle, radius, extent)
    outlier = 3.5  # standard deviations from the smooth outline
    kept = np.abs(radius - outline) < outlier * scatter * extent + FLOOR_MM
    if kept.sum() < LEAST_EDGES:
        return _none(f"too few edges: {kept.sum()} of {len(kept)} on a smooth outline")
    peaks = profiles[good][kept].max(axis=1)
    angle, rays, radius = angle[kept], rays[kept], radius[kept]
    wide, deep = np.square(look.spread_mm)  # variances
    bend = (wide * np.cos(angle) ** 2 + deep * np.sin(angle) ** 2) / (2 * radius)
    growth = np.log(10) / 10 / grey * _slopes(angle, peaks) / radius  # of power, nepers a mm
    fading = growth * (wide - deep) * np.sin(angle) * np.cos(angle)
    radius = radius + bend + fading
    unsure = 2.0  # times the correction for fading, which is its first order alone: standard deviation
    sigma = np.sqrt((scatter * extent[kept]) ** 2 + FLOOR_MM**2 + (unsure * fading) ** 2)
    across = rays / scale  # px for 1 mm
    covariance = sigma[:, None, None] ** 2 * across[:, :, None] * across[:, None, :]
    return Ring((circle[:2] + radius[:, None] * rays) / scale, covariance)


def _echo_middles(profiles: Array, drop: float, contrast: float) -> tuple[Array, Array]:
    """Middle and width of the echo in profiles : (n, m), in samples; NaN where it is weak or ends outside."""
    middle, extent = np.full((2, len(profiles)), np.nan)
    for k, profile in enumerate(profiles):
        top = int(profile.argmax())
        edge = profile[top] - drop
        if profile[top] - np.median(profile) < contrast:
            continue
        below = np.flatnonzero(profile < edge)
        before, after = below[below < top], below[below > top]
        if len(before) and len(after):
            i, j = before[-1], after[0]
            left = i + (edge - profile[i]) / (profile[i + 1] - profile[i])
            right = j - (edge - profile[j]) / (profile[j - 1] - profile[j])
            middle[k], extent[k] = (left + right) / 2, right - left
    return middle, extent


def _slopes(angle: Array, peaks: Array) -> Array:
    """Slopes : (n,) of an echo's grey level over the angle, of lines fitted in a Gaussian window around each.

    Where levels are clipped the slope is taken to change evenly between both ends, as on the crest of a mirror's echo.
    """
    clipped = 250.0  # grey level of 255, from which an echo's brightness isn't known
    known = peaks < clipped
    if known.sum() < LEAST_EDGES:
        return np.zeros_like(peaks)
    at, level = angle[known], peaks[known]
    fading_deg = 2.0  # sigma of the window in which the brightness' slope along the wall is taken
    weight = np.exp(-0.5 * ((at[:, None] - at) / np.deg2rad(fading_deg)) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    away = at - (weight @ at)[:, None]
    return np.interp(angle, at, (weight * away) @ level / np.maximum((weight * away**2).sum(axis=1), 1e-12))


def _smooth_outline(angle: Array, radius: Array, extent: Array) -> tuple[Array, float]:
    """An off-centre ellipse's radius at the angles, to first order, and the scatter about it in widths of the echo."""
    harmonics = [np.ones_like(angle), np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]
    design = np.column_stack(harmonics) / extent[:, None]
    result = least_squares(lambda p: design @ p - radius / extent, np.eye(5)[0] * np.median(radius), loss="soft_l1", f_scale=0.1)
    misfit = result.fun
    return radius + misfit * extent, float(NORMAL_MAD * np.median(np.abs(misfit)))


def _turned(covariance: Array, world_from_pixel: Array) -> Array:
    return propagate(world_from_pixel[:3, :2], covariance)


def _weigh(points: Array, covariance: Array, frames: NDArray[np.int64]) -> Tube:
    """Cylinder of least weighted squares; its radius' variance from the sums over images, whose points err together."""
    start = fit_cylinder(points).shape
    first, _, _ = np.linalg.svd(start.axis[:, None])
    across = first[:, 1:].T

    def away(p: Array) -> tuple[Array, Array]:
        axis = start.axis + p[2:4] @ across
        axis /= np.linalg.norm(axis)
        local = points - start.point - p[:2] @ across
        normal = local - np.outer(local @ axis, axis)
        distance = np.linalg.norm(normal, axis=1)
        return distance - p[4], normal / distance[:, None]

    begin = np.array([0, 0, 0, 0, start.radius])
    normal = away(begin)[1]
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normal, covariance, normal) + FLOOR_MM**2)
    robust = 3.0  # standard deviations, from which a point counts less in the cylinder's fit
    result = least_squares(lambda p: away(p)[0] / sigma, begin, x_scale="jac", loss="soft_l1", f_scale=robust)
    bread = np.linalg.inv(result.jac.T @ result.jac)
    gradients = _gradients(result.jac, result.fun, robust)
    scores = np.stack([gradients[frames == k].sum(axis=0) for k in np.unique(frames)])
    variance = bread @ (scores.T @ scores) @ bread * len(scores) / max(len(scores) - 1, 1)
    axis = start.axis + result.x[2:4] @ across
    shape = Cylinder("", start.point + result.x[:2] @ across, axis / np.linalg.norm(axis), float(result.x[4]))
    return Tube(shape, float(np.sqrt(variance[4, 4])), away(result.x)[0], frames)


def _gradients(jac: Array, misfit: Array, scale: float) -> Array:
    """Gradient : (n, p) of each point's soft_l1 loss `scale² (sqrt(1 + z) - 1)`, z the misfit over the scale, squared.

    It is the plain Jacobian times `misfit / sqrt(1 + z)`; SciPy's `least_squares` returns misfits as they are, but the Jacobian
    times the root of the loss' second derivative, `(1 + z)^(-3/4)`, so that jac^T jac is the Hessian.
    """
    return jac * (misfit * (1 + (misfit / scale) ** 2) ** 0.25)[:, None]


def _none(reason: str) -> Ring:
    return Ring(np.empty((0, 2)), np.empty((0, 2, 2)), reason)
