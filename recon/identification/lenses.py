"""A camera's lens from images of a board of discs: point spread, aperture and focus, by the blur of edges at many depths.

The edge of a disc at the depth z along the optical axis is spread by the pixel, by the point spread in focus, and by the disc of
confusion of a thin lens (docs/physics-optics.md, sections 2 and 3):

    s^2 = 1/12 + blur^2 + (c/4)^2,    c = D f |1/z_focus - 1/z| px,

for an entrance pupil D in mm and a focal length f in px. In 1/z that is a parabola: its opening tells D, its vertex the focus
and the blur there. So D and focus need depths on both sides of the focus, or enough on one; D is in mm, so that the f-number
needs the lens's focal length in mm besides.

What `recon.board_detection.edges` fits to such an edge is the normal distribution that is nearest by least squares. It isn't
quite as wide as s, as box and disc have no tails: `fitted_width` computes it, for the pixels that were looked at.

A print whose edge is itself spread by e mm adds (f e / z)^2, a parabola in 1/z, too: no image of it tells the two apart. It
passes for D^2 + 16 e^2 and for a focus that is farther in that ratio, little for e of 0.03 mm, but hides in the point
spread nearly whole.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import ndtr

from recon.board_detection import discs
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of, slopes_at
from recon.geometry.ellipses import Ellipses
from recon.identification.estimates import Estimate, Findings
from recon.identification.pose_fits import fit_in_poses
from recon.model.boards import Discs
from recon.model.calibration import Calibration
from recon.model.rig import DEVICES, Rig

Array = NDArray[np.float64]

PIXEL = 1 / 12  # px^2, variance of a pixel's width
BOX = np.array([[-0.49352, 0.114656], [-0.18883, 0.385344], [0.18883, 0.385344], [0.49352, 0.114656]])  # px: places and weights
# that have the moments of a square pixel along a line, averaged over its directions, up to the seventh: 1/12, 7/480, 0.003348
DISC_POINTS = 7  # of a disc's light along a line; enough up to discs of ten widths of the rest
RASTER = 0.053  # px, of what sampling takes off a narrow width
STEP_POINTS = 28  # of half a step's profile
WIDTH_STEPS = 6  # of Gauss and Newton to the fitted width
TERMS = 8  # unknowns: blur^2, D / focus, D, blur^2 across, down and by radius^2, the print's spread^2, the widths' own error
BLUR2, RATIO, APERTURE, FIELD, PRINT, MODEL = 0, 1, 2, slice(3, 6), 6, 7
UNITS = np.array([1, 1e-3, 1, 1, 1, 1, 1, 1])  # of their order
CHANCE = 2.0  # times its own error's variance, from which on a variation over the image counts
FREE = 3  # of these, that the poses' means determine
LEAST_APERTURE = 0.05  # mm, to begin with: a pinhole has no slopes
STEP, TINY = 1e-5, 1e-9  # of differences, px and px^2; of what is held to zero
OFF_FOCUS = 1.25  # ratio to the nearest or farthest place of a board, from which on a focus is another rig's
NEAREST, FARTHEST, STARTS = 0.4, 3.0, 25  # of the depths seen: where the focus is looked for, and how many places


@dataclass(frozen=True)
class LensLimits:
    """Which edges are used, and which results are given."""

    margin: float = 0.45  # of the gap between discs, and of a disc's radius, that is looked at beside an edge
    clipped: float = 0.02  # of the pixels about an edge that may be as bright as can be
    signal: float = 8.0  # contrast over noise
    blur: float = 0.25  # of the disc's shorter radius, at most
    outlier: float = 5.0  # standard deviations, of an edge's width
    model_px: float = 2e-4  # by which all widths may be off alike: what is left of `fitted_width` and the pixels' raster
    fewest: int = 20  # edges
    aperture: float = 0.15  # relative standard deviation of D up to which it is given: beyond, 1/D isn't normal
    focus: float = 0.1  # the same of the focus
    point_spread: float = 0.3  # the same of blur^2
    scale: float = 1e-3  # of lengths, by the board's print: a standard deviation


USUAL = LensLimits()


@dataclass(frozen=True)
class Rims:
    """Edges of n discs, as a camera saw them."""

    width: Array  # (n,) px, of the normal distribution fitted to the blurred edge, less the bias by noise
    sigma: Array  # (n,) px, its standard deviation by noise
    reach: Array  # (n,) px to either side, that was looked at
    radius: Array  # (n,) px
    depth: Array  # (n,) mm, of the disc's middle along the optical axis
    uneven: Array  # (n,) 1/mm^2, variance of 1/depth along the rim
    scale: Array  # (n,) px per unit of x/z, at the disc's place in the image
    place: Array  # (n, 2) from the image's middle, in half diagonals
    pose: NDArray[np.int64]  # (n,) number of the image

    def __getitem__(self, chosen: NDArray) -> "Rims":
        return Rims(*(getattr(self, field.name)[chosen] for field in fields(self)))


class FittedStep(NamedTuple):
    """The normal distribution nearest to a blurred edge."""

    width: Array  # (n,) px
    information: Array  # (n,) of the width, per px of edge, for a contrast over noise of 1


def measure_rims(
    image: NDArray,
    board: Discs,
    camera: Camera,
    world_from_board: rigid.Array,
    *,
    points: Array | None = None,
    pose: int = 0,
    full: float = 255,
    limits: LensLimits = USUAL,
) -> Rims:
    """Measure how wide the edges of a board's discs are in an image.

    Parameters
    ----------
    image : (h, w) DN
    camera, world_from_board : calibrated; see `recon.optical_calibration`
    points : (m, 3) mm, optional
        Places of the discs in the board's frame, if they differ from its design.
    pose : int
        Number of the image.
    full : float
        Largest value that the image can have.

    Discs that the image doesn't hold whole, with too little contrast or with glare are left out.
    """
    centres = np.ascontiguousarray(board.points() if points is None else points)
    image = np.asarray(image, float)
    outlines = Ellipses(*ellipses_of(camera, world_from_board, centres, board.diameter_mm / 2))
    with np.errstate(invalid="ignore"):
        extent = np.sqrt(np.einsum("nij,nij->ni", outlines.shape, outlines.shape)) * (1 + limits.margin)
        inside = ((outlines.centre - extent > 1) & (outlines.centre + extent < np.array(camera.size) - 2)).all(axis=1)
    chosen = np.flatnonzero(inside)
    if not len(chosen):
        none = np.zeros(0)
        return Rims(none, none, none, none, none, none, none, np.zeros((0, 2)), np.zeros(0, np.int64))
    gap = 2 * max(board.pitch_mm / board.diameter_mm - 1, 0.1)  # in radii
    margin = np.maximum(limits.margin * min(gap, 1.0) * outlines[chosen].semi_axes[:, 1], 2.0)
    found = discs.measure(full - image if board.white else image, outlines[chosen], margin, full)
    edges, (longer, shorter) = found.edges, found.fit.ellipses.semi_axes.T
    reach = np.minimum(margin, discs.NEAR[0] + discs.NEAR[1] * edges.blur)
    width, sigma = widths(found, reach)
    contrast, known = edges.outside - edges.inside, np.isfinite(edges.sigma).mean(axis=1)
    good = (contrast > limits.signal * edges.noise) & (edges.clipped <= limits.clipped) & (known > 0.95)
    good &= (edges.blur < limits.blur * shorter) & np.isfinite(width + sigma)
    places = rigid.apply(world_from_board, centres[chosen])
    tilt2 = ((camera.camera_from_world[:3, :3] @ world_from_board[:3, :3])[2, :2] ** 2).sum()
    depth = rigid.apply(camera.camera_from_world, places)[:, 2]
    slopes = slopes_at(camera, places) @ camera.camera_from_world[:3, :3].T
    middle = (np.array(camera.size) - 1) / 2
    rims = Rims(
        width,
        sigma,
        reach,
        np.sqrt(longer * shorter),
        depth,
        (board.diameter_mm / 2) ** 2 * tilt2 / 2 / depth**4,
        depth * np.sqrt(np.abs(np.linalg.det(slopes[..., :2]))),
        (outlines.centre[chosen] - middle) / np.linalg.norm(middle),
        np.full(len(chosen), pose),
    )
    return rims[good]


def widths(found: discs.Discs, reach: Array) -> tuple[Array, Array]:
    """Widths of the edges of discs, and their standard deviations : (n,) px.

    Each sector's offset follows the noise of its own pixels, which takes its variance off the blur's (Box 1971, the bias of
    least squares to second order: offset and width bend the model alike). The width's own information is that of a straight edge
    as long as the rim, with brightness on both sides unknown.
    """
    edges, (longer, shorter) = found.edges, found.fit.ellipses.semi_axes.T
    finite = np.isfinite(edges.sigma)
    wobble = np.where(finite, edges.sigma, 0.0) ** 2
    width = np.sqrt(edges.blur**2 + wobble.sum(axis=1) / np.maximum(finite.sum(axis=1), 1))
    about = 3 * (longer + shorter)
    rim = np.pi * (about - np.sqrt((3 * longer + shorter) * (longer + 3 * shorter)))  # Ramanujan 1914
    width = width + RASTER * np.exp(-2 * (np.pi * width) ** 2)
    information = fitted_width(np.maximum(width**2 - PIXEL, 0.0), np.zeros_like(width), reach).information
    return width, edges.noise / np.abs(edges.outside - edges.inside) / np.sqrt(information * rim)


def fitted_width(blur2: Array, disc: Array, reach: Array) -> FittedStep:
    """The normal distribution that fits an edge best which is spread by a pixel, a normal point spread and a disc.

    Least squares over the pixels within reach, with the brightness of both sides free, is that of half the step, which is the
    other half's mirror image: of the profile G(t), 0 <= t <= reach, with `C (Phi(t/w) - 1/2)`.

    Parameters
    ----------
    blur2 : (n,) px^2, variance of the point spread
    disc : (n,) px, diameter of a uniform disc
    reach : (n,) px
    """
    turn = np.arange(1, DISC_POINTS + 1) * np.pi / (DISC_POINTS + 1)
    along, weight = np.cos(turn) / 2, 2 / (DISC_POINTS + 1) * np.sin(turn) ** 2  # Gauss and Chebyshev, second kind
    nodes, parts = np.polynomial.legendre.leggauss(STEP_POINTS)
    t, part = reach[:, None] * (nodes + 1) / 2, reach[:, None] * parts / 2  # (n, k)
    spread = np.sqrt(np.maximum(blur2, 1e-4))[:, None]
    profile = np.full(t.shape, -0.5)
    for place, share in zip(along, weight, strict=True):
        for shift, part_of_pixel in BOX:
            profile += share * part_of_pixel * ndtr((t - disc[:, None] * place - shift) / spread)
    width, level = np.sqrt(np.maximum(blur2, 0) + disc**2 / 16 + PIXEL), np.ones(len(t))
    information = np.zeros(len(t))
    for _ in range(WIDTH_STEPS):
        z = t / width[:, None]
        half, peak = ndtr(z) - 0.5, np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
        by_width = -level[:, None] * z * peak / width[:, None]
        left = profile - level[:, None] * half
        a, b, c = ((part * x * y).sum(axis=1) for x, y in ((half, half), (half, by_width), (by_width, by_width)))
        p, q = (part * half * left).sum(axis=1), (part * by_width * left).sum(axis=1)
        determinant = a * c - b * b
        level = level + (c * p - b * q) / determinant
        width = width * np.exp(np.clip((a * q - b * p) / determinant / width, -0.5, 0.5))
        information = 2 * determinant / a
    return FittedStep(width, information)


def joined(parts: Sequence[Rims]) -> Rims:
    """Edges of several images, one after the other."""
    return Rims(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Rims)))


def find_lens(
    rims: Rims, name: str = "cam1", *, focal_length: Estimate | None = None, print_mm: float = 0.02, limits: LensLimits = USUAL
) -> Findings:
    """Find a lens's point spread, f-number and focus from the edges of discs at many depths.

    Parameters
    ----------
    rims : Rims
        Of all poses of the board; see `measure_rims` and `joined`.
    name : str
        Of the camera.
    focal_length : Estimate, optional
        mm, as engraved on the lens, or as calibrated, by the pixels' size. The f-number is this over the entrance pupil.
    print_mm : float
        Spread of the printed edges, as a standard deviation along a line, that is taken as likely; 0 for one etched in
        glass. An office printer's are spread over some 0.05 mm from 10 to 90 %, which is 0.02 mm.

    A point spread that varies over the image is allowed for as a polynomial of second degree; as the lens's description has one
    number, the variation counts to its standard deviation. So does what poses have in common beyond noise, as by motion.
    """
    fields_of = {key: f"{name}.lens.{key}" for key in ("blur_px", "f_number", "focus_mm")}
    if len(rims.width) < max(limits.fewest, TERMS):
        why = f"needs {limits.fewest} discs with clear edges, found {len(rims.width)}"
        return Findings(unknown=dict.fromkeys(fields_of.values(), why))
    fit = _fit(rims, print_mm, limits)
    poses, depths = len(np.unique(fit.rims.pose)), np.percentile(fit.rims.depth, [0, 100])
    source = f"edges of {len(fit.rims.width)} discs in {poses} poses, {depths[0]:.0f} to {depths[1]:.0f} mm"
    (blur2, ratio, aperture), covariance = fit.values[: APERTURE + 1], fit.covariance[: APERTURE + 1, : APERTURE + 1]
    sigma = np.sqrt(np.diag(covariance))
    focus, by_focus = aperture / ratio, np.array([0, -aperture / ratio**2, 1 / ratio])
    focus_sigma = np.hypot(np.sqrt(by_focus @ covariance @ by_focus), limits.scale * focus)
    estimates, unknown = {}, {}
    parted = sigma[APERTURE] < limits.aperture * abs(aperture) and focus > 0
    seen = _in_words(fit)
    if not parted:
        why = f"depths from {depths[0]:.0f} to {depths[1]:.0f} mm don't part the aperture from the focus: {seen}"
        return Findings(unknown=dict.fromkeys(fields_of.values(), why))
    if focus_sigma < limits.focus * focus:
        estimates[fields_of["focus_mm"]] = Estimate(float(focus), float(focus_sigma), source)
    else:
        unknown[fields_of["focus_mm"]] = f"too far from the depths seen, {focus:.0f} +- {focus_sigma:.0f} mm: {seen}"
    if focal_length is None:
        pupil = f"the entrance pupil is {abs(aperture):.3f} +- {sigma[APERTURE]:.3f} mm wide"
        unknown[fields_of["f_number"]] = f"needs the focal length in mm, as engraved, or the pixel's size: {pupil}"
    else:
        relative = np.hypot(sigma[APERTURE] / aperture, focal_length.sigma / focal_length.value)
        number = focal_length.value / abs(aperture)
        estimates[fields_of["f_number"]] = Estimate(float(number), float(number * relative), source)
    spread = np.hypot(sigma[BLUR2], fit.uneven)
    if sigma[BLUR2] < limits.point_spread * blur2:
        also = f", varying by {fit.uneven / 2 / np.sqrt(blur2):.3f} px over the image" if fit.uneven else ""
        estimates[fields_of["blur_px"]] = Estimate(float(np.sqrt(blur2)), float(spread / 2 / np.sqrt(blur2)), source + also)
    else:
        most = np.sqrt(max(blur2, 0) + 2 * spread)
        unknown[fields_of["blur_px"]] = f"below {most:.2f} px, not told from the defocus: {seen}"
    return Findings(estimates, unknown)


class _Fit(NamedTuple):
    """The lens that fits."""

    values: Array  # (TERMS,)
    covariance: Array  # (TERMS, TERMS)
    uneven: float  # px^2, RMS of the variation of blur^2 over the image, beyond its own errors
    rims: Rims  # those used


def _fit(rims: Rims, print_mm: float, limits: LensLimits) -> _Fit:
    """Weighted least squares of the widths."""
    terms = np.column_stack([rims.place, (rims.place**2).sum(axis=1)])
    shape, units, held = terms - terms.mean(axis=0), UNITS.copy(), np.full(TERMS, np.nan)
    units[PRINT], units[MODEL] = max(print_mm**2, TINY), limits.model_px
    held[[PRINT, MODEL]] = 0.0
    found = fit_in_poses(
        rims.width, rims.sigma, rims.pose, partial(_predict, rims, shape), _start(rims), units, held, free=FREE,
        outlier=limits.outlier,
    )  # fmt: skip
    across, known = shape.T @ shape / len(shape), found.covariance[FIELD, FIELD]
    variation, chance = found.values[FIELD] @ across @ found.values[FIELD], np.trace(across @ known)
    uneven = np.sqrt(variation - chance) if variation > CHANCE * chance else 0.0
    return _Fit(found.values, found.covariance, float(uneven), rims[found.kept])


def _start(rims: Rims) -> Array:
    """Unknowns to begin with : (TERMS,), by the focus from which blur^2 is most nearly a parabola."""
    best, values = np.inf, np.zeros(TERMS)
    for focus in np.geomspace(NEAREST * rims.depth.min(), FARTHEST * rims.depth.max(), STARTS):
        opening = rims.scale**2 * ((1 / focus - 1 / rims.depth) ** 2 + rims.uneven) / 16
        slopes, weight = np.column_stack([np.ones_like(opening), opening]), 1 / (2 * rims.width * rims.sigma)
        wanted = (rims.width**2 - PIXEL) * weight
        (blur2, aperture2), _ = nnls(slopes * weight[:, None], wanted)
        cost = float(((slopes @ [blur2, aperture2] * weight - wanted) ** 2).sum())
        if cost < best:
            aperture = max(float(np.sqrt(aperture2)), LEAST_APERTURE)
            best, values[: FIELD.start] = cost, (max(blur2, 0.01), aperture / focus, aperture)
    return values


def _predict(rims: Rims, shape: Array, values: Array) -> tuple[Array, Array]:
    """Widths : (n,) px that are expected, and their derivatives : (n, TERMS).

    Across a rim of the radius R, light comes from a curved edge: to second order in s / R that adds s^4 / 2 R^2 to s^2.
    """
    away = values[RATIO] - values[APERTURE] / rims.depth
    disc = rims.scale * np.sqrt(away**2 + values[APERTURE] ** 2 * rims.uneven) + TINY
    printed = (rims.scale / rims.depth) ** 2
    blur2 = values[BLUR2] + shape @ values[FIELD] + printed * values[PRINT]
    width = fitted_width(blur2, disc, rims.reach).width
    by_blur2 = (fitted_width(blur2 + STEP, disc, rims.reach).width - width) / STEP
    by_disc = (fitted_width(blur2, disc + STEP, rims.reach).width - width) / STEP
    by_ratio = by_disc * rims.scale**2 * away / disc
    by_aperture = by_disc * rims.scale**2 * (values[APERTURE] * rims.uneven - away / rims.depth) / disc
    slopes = np.column_stack(
        [by_blur2, by_ratio, by_aperture, by_blur2[:, None] * shape, by_blur2 * printed, np.ones_like(width)]
    )
    return width * (1 + (width / rims.radius) ** 2 / 4) + values[MODEL], slopes


def _in_words(fit: _Fit) -> str:
    """What edges show in any case."""
    depths = np.percentile(fit.rims.depth, [5, 50, 95])
    disc = np.median(fit.rims.scale) * (fit.values[RATIO] - fit.values[APERTURE] / depths)
    spreads = ", ".join(f"{spread:.2f}" for spread in np.sqrt(np.maximum(fit.values[BLUR2] + disc**2 / 16, 0)))
    return f"the image of a point is spread by {spreads} px at {', '.join(f'{depth:.0f}' for depth in depths)} mm"


def focused_on(rig: Rig, calibration: Calibration, boards: Sequence[Array], known: Findings) -> tuple[Rig, list[str]]:
    """The rig, with lenses focused on the middle of a board's places where their own focus is far from all of these; in words.

    The focus of another rig, with which a description begins, would blur whatever is predicted there. A measured one stays; so
    does one within a quarter of the nearest or the farthest place.

    Parameters
    ----------
    boards : each (n, 3) mm
        Points of the board in its poses, in the world.
    known : Findings
        What is measured now.
    """
    changed, said, points = {}, list[str](), np.concatenate(boards)
    for name in (name for name in DEVICES if name in calibration.cameras):
        field, device = f"{name}.lens.focus_mm", getattr(rig, name)
        depths = rigid.apply(calibration.cameras[name].camera_from_world, points)[:, 2]
        near, middle, far = float(depths.min()), float(np.median(depths)), float(depths.max())
        focus = device.lens.focus_mm
        if field in known.estimates or field in rig.measured or near / OFF_FOCUS <= focus <= far * OFF_FOCUS:
            continue
        changed[name] = device.model_copy(update={"lens": device.lens.model_copy(update={"focus_mm": middle})})
        said.append(
            f"{field}: {focus:.0f} mm, as the rig begins with, isn't where the board stood, {near:.0f} to {far:.0f} mm away: "
            f"{middle:.0f} mm is assumed"
        )
    return rig.model_copy(update=changed), said
