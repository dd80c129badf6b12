"""Light over the image: the vignetting of camera and projector, and the room's share, by the white of a board in several poses.

White that the projector lights, all its pixels on, at the distance d and depth z_p from it (docs/physics-optics.md, sections
1 to 3), sends to a pixel

    I = black + K [ E V_p + room ] V_c cos^4(theta_c),    E = cos(theta_s) / (cos^3(theta_p) d^2),    V = 1 - v r^2,

r being the distance from the image's middle, 1 in a corner, of the camera's or the projector's pixel. With calibration and
poses known, only K, both v and the room are unknown, and as a board stands in other places of both images, near and far, upright
and tilted, each shows by itself.

Paper isn't quite matt. Three deviations are fitted along, each held to zero by what is usual: a power of both cosines [Minnaert
1941], a sheen about the mirror's direction as of microfacets [Walter et al. 2007, GGX], and a smooth unevenness of the board's
white. A pose may be brighter than the others, as lamps drift.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import slopes_at
from recon.identification.estimates import Estimate, Findings
from recon.identification.pose_fits import fit_in_poses
from recon.model.boards import Discs

Array = NDArray[np.float64]

UNKNOWNS = ("level", "camera", "projector", "room", "black", "minnaert")  # the first ones; then sheens, then the white's terms
LEVEL, CAMERA, PROJECTOR, ROOM, BLACK, MINNAERT = range(len(UNKNOWNS))
METRE = 1e6  # mm^2 of a square metre: E counts in those of a surface that faces the projector, a metre away
FEWEST_POSES = 3


@dataclass(frozen=True)
class WhiteLimits:
    """Which white is used, what paper usually is, and which results are given."""

    clear: float = 0.2  # of the gap between discs, to the nearest rim at least
    edge_px: float = 4.0  # of that, taken by the rim's blur
    largest_px: int = 6  # half a patch's side
    roughness: tuple[float, ...] = (0.12, 0.25)  # of sheens, GGX alpha: laminated and satin paper
    sheen: float = 0.05  # a standard deviation: of the sheen of glass over white paper, 4 % reflected
    minnaert: float = 0.05  # the same of the exponent beyond 1
    white: float = 0.01  # the same of each term of the white's unevenness, at the board's sides
    outlier: float = 5.0  # standard deviations
    fewest: int = 40  # patches
    vignetting: float = 0.1  # standard deviation up to which a vignetting is given
    signal: float = 2.0  # room over its standard deviation, from which on it is given


USUAL = WhiteLimits()


@dataclass(frozen=True)
class Whites:
    """n patches of white between discs, as a camera saw them."""

    level: Array  # (n,) DN, mean
    sigma: Array  # (n,) DN, of the mean, by the pixels' scatter
    corner2: Array  # (n,) squared distance from the image's middle, 1 in a corner
    cosine4: Array  # (n,) of the angle from the camera's axis
    light: Array  # (n,) E above, at a projector without vignetting
    shown2: Array  # (n,) as `corner2`, of the projector's pixel
    cosines: Array  # (n, 2) of the angles between normal and light, and normal and view
    half: Array  # (n,) of the angle between the normal and the bisector of light and view
    place: Array  # (n, 2) on the board, -1 to 1 from side to side
    board: Array  # (n, 3) mm, in the board's frame
    pose: NDArray[np.int64]  # (n,) number of the image

    def __getitem__(self, chosen: NDArray) -> "Whites":
        return Whites(*(getattr(self, field.name)[chosen] for field in fields(self)))


def measure_whites(
    image: NDArray,
    board: Discs,
    camera: Camera,
    projector: Camera,
    world_from_board: rigid.Array,
    *,
    points: Array | None = None,
    pose: int = 0,
    full: float = 255,
    limits: WhiteLimits = USUAL,
) -> Whites:
    """Measure how bright a board's white is between its discs, in an image that the projector lights with all its pixels on.

    Parameters
    ----------
    image : (h, w) DN
    camera, projector, world_from_board : calibrated; see `recon.optical_calibration`
    points : (m, 3) mm, optional
        Places of the discs in the board's frame, if they differ from its design.
    pose : int
        Number of the image.
    full : float
        Largest value that the image can have; patches with such pixels are left out.

    Raises
    ------
    ValueError
        If the board's discs are white: its ground isn't.
    """
    if board.white:
        raise ValueError("board: expected dark discs on white, found white ones")
    centres = np.ascontiguousarray(board.points() if points is None else points)
    flat, clear, places = _between(centres, board, limits)
    world = rigid.apply(world_from_board, flat)
    pixels, shown = camera.project(world), projector.project(world)
    with np.errstate(invalid="ignore"):
        scale = np.linalg.svd(slopes_at(camera, world) @ world_from_board[:3, :2], compute_uv=False)[:, -1]  # px/mm
        reach = np.minimum((clear * scale - limits.edge_px) / np.sqrt(2), limits.largest_px)
        inside = (np.abs(shown - _middle(projector)) <= _middle(projector)).all(axis=1) & (reach >= 1)
        inside &= (np.abs(pixels - _middle(camera)) <= _middle(camera) - limits.largest_px - 1).all(axis=1)
    level, sigma = np.zeros(len(flat)), np.zeros(len(flat))
    for k in np.flatnonzero(inside):
        (u, v), r = np.rint(pixels[k]).astype(int), int(reach[k])
        patch = np.asarray(image[v - r : v + r + 1, u - r : u + r + 1], float)
        inside[k] = patch.max() < full
        level[k], sigma[k] = patch.mean(), np.sqrt((patch.var() + 1 / 12) / patch.size)
    whites = Whites(
        level, sigma, **_rays(flat, camera, projector, world_from_board), place=places, board=flat, pose=np.full(len(flat), pose)
    )
    return whites[inside & (whites.cosines > 0).all(axis=1)]


def placed(whites: Whites, camera: Camera, projector: Camera, world_from_board: Mapping[int, Array]) -> Whites:
    """The same patches, as other optics and poses, by their numbers, place them."""
    rows = {k: np.flatnonzero(whites.pose == k) for k in world_from_board}
    parts = [replace(whites[rows[k]], **_rays(whites.board[rows[k]], camera, projector, world_from_board[k])) for k in rows]
    return joined(parts)[np.argsort(np.concatenate(list(rows.values())))]


def _rays(flat: Array, camera: Camera, projector: Camera, world_from_board: Array) -> dict[str, Array]:
    """Fields of `Whites` by the ways of light, of places : (n, 3) mm in the board's frame."""
    world = rigid.apply(world_from_board, flat)
    pixels, shown = camera.project(world), projector.project(world)
    normal = -world_from_board[:3, 2]  # towards the viewer
    from_camera, from_projector = world - camera.centre, world - projector.centre
    distance2 = (from_projector**2).sum(axis=1)
    views = [-way / np.linalg.norm(way, axis=1)[:, None] for way in (from_projector, from_camera)]
    cosines = np.column_stack([view @ normal for view in views])
    bisector = views[0] + views[1]
    slant, axis = rigid.apply(projector.camera_from_world, world)[:, 2] / np.sqrt(distance2), camera.camera_from_world
    return {
        "corner2": ((pixels - _middle(camera)) ** 2).sum(axis=1) / (_middle(camera) ** 2).sum(),
        "cosine4": (rigid.apply(axis, world)[:, 2] / np.linalg.norm(from_camera, axis=1)) ** 4,
        "light": METRE * cosines[:, 0] / slant**3 / distance2,
        "shown2": ((shown - _middle(projector)) ** 2).sum(axis=1) / (_middle(projector) ** 2).sum(),
        "cosines": cosines,
        "half": bisector @ normal / np.linalg.norm(bisector, axis=1),
    }


def joined(parts: Sequence[Whites]) -> Whites:
    """Patches of several images, one after the other."""
    return Whites(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Whites)))


def find_vignetting(
    whites: Whites, name: str = "cam1", *, black: Estimate, otherwise: Sequence[Whites] = (), limits: WhiteLimits = USUAL
) -> Findings:
    """Find the vignetting of a camera and of the projector, and the room's light, from a board's white in several poses.

    Parameters
    ----------
    whites : Whites
        Of all poses, under one exposure; see `measure_whites` and `joined`.
    name : str
        Of the camera.
    black : Estimate
        DN of a pixel without light, as of dark frames.
    otherwise : sequence of Whites
        The same patches as optics place them that are one standard deviation off, along each axis of their covariance: see
        `placed` and `calibrated_optics.one_sigma_off`. Of a quiet sensor these errors are several times those by noise.

    Of the room, `room.over_projector` is its irradiance over that which the projector, all on, casts on a surface that faces
    it on its axis a metre away: times its flux in W/m^2 there, and 542 lm/W, that is `room_lux`.
    """
    keys = {CAMERA: f"{name}.lens.vignetting", PROJECTOR: "projector.lens.vignetting", ROOM: "room.over_projector"}
    lux = {
        "tracing.room_lux": "images tell the room's light by the projector's alone, see room.over_projector: needs its flux in W"
    }
    poses = len(np.unique(whites.pose))
    if len(whites.level) < limits.fewest or poses < FEWEST_POSES:
        why = f"needs {limits.fewest} white patches in {FEWEST_POSES} poses, found {len(whites.level)} in {poses}"
        return Findings(unknown=dict.fromkeys(keys.values(), why) | lux)
    sheens, terms = len(limits.roughness), _white_terms(whites.place).shape[1]
    start = np.zeros(len(UNKNOWNS) + sheens + terms)
    start[BLACK] = black.value
    start[LEVEL] = np.log(np.median((whites.level - black.value) / (whites.light * whites.cosine4)))
    units = np.concatenate(
        [[1, 0.1, 0.1, 0.1, max(black.sigma, 1e-6), limits.minnaert], [limits.sheen] * sheens, [limits.white] * terms]
    )
    held = np.where(np.arange(len(start)) < BLACK, np.nan, start)
    fit = fit_in_poses(
        np.log(whites.level), whites.sigma / whites.level, whites.pose, partial(_predict, whites, limits.roughness),
        start, units, held, free=len(UNKNOWNS) - 2, outlier=limits.outlier,
    )  # fmt: skip
    expected = _predict(whites, limits.roughness, fit.values)[0]
    by_optics = [fit.gain @ (_predict(other, limits.roughness, fit.values)[0] - expected) for other in otherwise]
    variance = np.diag(fit.covariance) + np.square(by_optics).sum(axis=0) if by_optics else np.diag(fit.covariance)
    sigma, used = np.sqrt(variance), whites[fit.kept]
    gloss = float(np.max(np.abs(_sheens(used, limits.roughness) @ fit.values[len(UNKNOWNS) :][:sheens])))
    source = f"{len(used.level)} patches of white in {poses} poses, sheen of up to {100 * gloss:.1f} %"
    estimates, unknown = {}, lux
    for which, key in keys.items():
        found = Estimate(float(fit.values[which]), float(sigma[which]), source)
        seen = np.sqrt((used.corner2 if which == CAMERA else used.shown2).max())
        if which == ROOM and found.value < limits.signal * found.sigma:
            unknown[key] = (
                f"not told from black: below {max(found.value, 0) + 2 * found.sigma:.3f} of the projector's a metre away"
            )
        elif which != ROOM and found.sigma > limits.vignetting:
            unknown[key] = f"{found.value:.2f} +- {found.sigma:.2f}: white was seen only up to {seen:.2f} of the way to a corner"
        else:
            estimates[key] = found
    return Findings(estimates, unknown)


def _between(centres: Array, board: Discs, limits: WhiteLimits) -> tuple[Array, Array, Array]:
    """Places between discs : (k, 3) mm in the board's frame, distances from the nearest rim : (k,) mm, and `Whites.place`."""
    low, high = centres.min(axis=0), centres.max(axis=0)
    axes = [np.arange(low[k], high[k] + 1e-6, board.spacing_mm / 2) for k in range(2)]
    x, y = (axis.ravel() for axis in np.meshgrid(*axes))
    away = np.hypot(x[:, None] - centres[:, 0], y[:, None] - centres[:, 1])
    nearest, clear = away.argmin(axis=1), away.min(axis=1) - board.diameter_mm / 2
    chosen = clear > limits.clear * (board.pitch_mm - board.diameter_mm)
    flat = np.column_stack([x, y, centres[nearest, 2]])[chosen]
    return flat, clear[chosen], (2 * (flat - low)[:, :2] / (high - low)[:2]) - 1


def _predict(whites: Whites, roughness: Sequence[float], values: Array) -> tuple[Array, Array]:
    """Logarithm of the levels that are expected : (n,), and its derivatives : (n, g)."""
    first, count = len(UNKNOWNS), len(roughness)
    sheens, terms, slant = _sheens(whites, roughness), _white_terms(whites.place), np.log(whites.cosines).sum(axis=1)
    matt = np.exp(values[MINNAERT] * slant)
    body = matt + sheens @ values[first : first + count]
    shown, seen = 1 - values[PROJECTOR] * whites.shown2, 1 - values[CAMERA] * whites.corner2
    white = np.exp(values[LEVEL] + terms @ values[first + count :]) * whites.cosine4
    lit, room = whites.light * shown * body, values[ROOM]
    level = values[BLACK] + white * seen * (lit + room)
    slopes = np.empty((len(level), len(values)))
    slopes[:, LEVEL] = white * seen * (lit + room)
    slopes[:, CAMERA] = -white * whites.corner2 * (lit + room)
    slopes[:, PROJECTOR] = -white * seen * whites.light * whites.shown2 * body
    slopes[:, ROOM], slopes[:, BLACK] = white * seen, 1
    slopes[:, MINNAERT] = white * seen * whites.light * shown * matt * slant
    slopes[:, first : first + count] = (white * seen * whites.light * shown)[:, None] * sheens
    slopes[:, first + count :] = slopes[:, [LEVEL]] * terms
    level = np.maximum(level, 1e-3)
    return np.log(level), slopes / level[:, None]


def _sheens(whites: Whites, roughness: Sequence[float]) -> Array:
    """Density of mirrors along the bisector over that of a sheen of alpha 1, and over the cosine of the view : (n, k).

    Light from a coat that reflects 4 % on white is some 0.05 of the body's times this.
    """
    alpha2 = np.array(roughness) ** 2
    return alpha2 / (whites.half[:, None] ** 2 * (alpha2 - 1) + 1) ** 2 / whites.cosines[:, [1]] * (1 / np.pi)


def _white_terms(place: Array) -> Array:
    """Terms of a white that changes over the board : (n, 5)."""
    x, y = place.T
    return np.column_stack([x, y, x * x - 1 / 3, x * y, y * y - 1 / 3])


def _middle(camera: Camera) -> Array:
    return (np.array(camera.size) - 1) / 2
