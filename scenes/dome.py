"""The surface of a breast as a height over its footprint, in the phantom's frame.

Phantom frame: the base lies in z = 0, z points up to the apex, x along the long side, the origin in the middle of the
footprint. A point of the dome is named by (rho, theta): theta is the direction from the apex, and rho runs from 0 at the apex
to 1 at the rim. Curves of constant rho are circles near the apex and take on the footprint's outline towards the rim.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from scenes.noise import smooth_noise

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


@dataclass(frozen=True)
class Form:
    """The numbers that shape the dome; lengths in mm."""

    size: tuple[float, float, float]  # length, width, height with the nipple
    apex: tuple[float, float]  # of the dome, from the middle of the footprint
    taper: float  # relative change of the half width from the middle to the ends: a teardrop
    fullness: float  # how far the profile swells on the full side and sinks on the other
    steepness: float  # 0 to 1: how much of a half ellipse the profile is; 1 meets the base at a right angle
    nipple_width: float
    nipple_height: float
    areola_width: float
    areola_height: float
    montgomery_bumps: int
    unevenness: float  # standard deviation of the slow irregularity
    relief: float  # standard deviation of the skin's texture
    edge: float  # typical edge of a facet


@dataclass(frozen=True, eq=False)
class Dome:
    """The skin's mesh, open at the rim, and how much each vertex belongs to areola and nipple."""

    vertices: Array  # (n, 3), mm; the last `rim` vertices lie on the rim, in z = 0
    faces: Faces  # (m, 3), outwards
    rim: int  # number of vertices on the rim
    areola: Array  # (n,), 0 to 1
    nipple: Array  # (n,), 0 to 1
    bumps: Array  # (n,), 0 to 1


def dome(form: Form, rng: np.random.Generator) -> Dome:
    """Build the dome; its bounding box is exactly `form.size`, standing on z = 0."""
    reach = (form.size[0] + form.size[1]) / 4  # a mean distance from the apex to the rim
    height = form.size[2] - form.nipple_height - form.areola_height
    rho = _rings(form, reach, height)
    ring, theta, faces = disc(len(rho) - 2)
    rho = rho[ring]

    blend = _smoothstep((rho - 0.2) / 0.8)
    distance = rho * (reach + (_rim_distance(form, theta) - reach) * blend)
    offset = distance[:, None] * np.column_stack([np.cos(theta), np.sin(theta)])
    plan = offset + form.apex

    full_side = np.cos(theta - np.arctan2(form.apex[1], form.apex[0]))
    z = height * _profile(rho - form.fullness * full_side * 4 * rho**3 * (1 - rho), form.steepness)
    inland = _smoothstep((1 - rho) / 0.15)  # irregularities fade before the rim, which must stay flat and in place
    uneven = smooth_noise(plan, 70, rng)
    z += form.unevenness * inland * (uneven - uneven[0])  # none at the apex, so that the nipple's height is right
    areola, nipple, bumps, raised = _areola(form, offset, rng)
    vertices = np.column_stack([plan, z + raised])
    texture = 0.8 * smooth_noise(vertices, 3.2, rng) + 0.6 * smooth_noise(vertices, 9, rng)
    vertices[:, 2] += form.relief * inland * texture
    return Dome(_fit(vertices, form.size), faces, int((ring == ring[-1]).sum()), areola, nipple, bumps)


def disc(rings: int) -> tuple[Faces, Array, Faces]:
    """Triangulate a disc by concentric rings, ring k of 6 k points, and a last ring that repeats the angles of the one before.

    Returns
    -------
    ring, theta : (n,) int, (n,) float rad
        Which ring a point lies on, 0 being the centre, and at which angle.
    faces : (m, 3) int
        Anticlockwise.
    """
    counts = np.array([1, *(6 * np.arange(1, rings + 1)), 6 * rings])
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    ring = np.repeat(np.arange(rings + 2), counts)
    theta = 2 * np.pi * (np.arange(counts.sum()) - first[ring]) / counts[ring]
    faces = []
    for k in range(1, rings + 1):
        sector, step = (index.ravel() for index in np.meshgrid(np.arange(6), np.arange(k), indexing="ij"))
        outer = sector * k + step
        inner = sector * (k - 1) + step
        a, b = first[k] + outer, first[k] + (outer + 1) % counts[k]
        c, d = first[k - 1] + inner % counts[k - 1], first[k - 1] + (inner + 1) % counts[k - 1]
        faces += [np.stack([a, b, c], 1), np.stack([b, d, c], 1)[step < k - 1]]
    along = np.arange(6 * rings)
    a, b = first[rings + 1] + along, first[rings + 1] + (along + 1) % (6 * rings)
    c, d = first[rings] + along, first[rings] + (along + 1) % (6 * rings)
    faces += [np.stack([a, b, c], 1), np.stack([b, d, c], 1)]
    return ring, theta, np.concatenate(faces)


def _rings(form: Form, reach: float, height: float) -> Array:
    """Values of rho at equal steps along a mean profile, nipple and all, and the support ring at the rim."""
    rho = np.linspace(0, 1, 4001)
    z = height * _profile(rho, form.steepness) + form.nipple_height * _nipple(rho * reach, form.nipple_width)
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(rho) * reach, np.diff(z)))])
    steps = int(np.ceil(length[-1] / form.edge))
    support = 2e-4  # last step of rho, which keeps interpolated normals true up to the rim
    return np.append(np.interp(np.linspace(0, length[-1], steps + 1), length, rho)[:-1], [1 - support, 1])


def _profile(rho: Array, steepness: float) -> Array:
    """Relative height over rho: an elliptic cap whose slope eases over the foot; 1 at the apex, 0 at the rim."""
    x = np.linspace(0, 1, 4001)
    slope = steepness**2 * x / np.sqrt(1 - (steepness * x) ** 2)
    foot = 0.05  # last part of rho, over which the skin turns in to the base
    foot_slope = 0.45  # of the slope left at the very rim
    slope *= 1 - (1 - foot_slope) * _smoothstep((x - (1 - foot)) / foot)
    fall = cumulative_trapezoid(slope, x, initial=0)
    return np.interp(rho, x, 1 - fall / fall[-1])


def _rim_distance(form: Form, theta: Array) -> Array:
    """Distance from the apex to the footprint's outline, seen from the apex in the directions theta."""
    outline_points = 4096
    turn = 2 * np.pi * np.arange(outline_points) / outline_points
    cos, sin = np.cos(turn), np.sin(turn)
    footprint_power = 2.25  # superellipse exponent: a little fuller than an ellipse
    radius = (np.abs(cos) ** footprint_power + np.abs(sin) ** footprint_power) ** (-1 / footprint_power)
    x, y = radius * cos, radius * sin
    outline = np.column_stack([x * form.size[0] / 2, y * (1 + form.taper * x) * form.size[1] / 2]) - form.apex
    angle = np.arctan2(outline[:, 1], outline[:, 0])
    order = np.argsort(angle)
    return np.interp(theta, angle[order], np.linalg.norm(outline, axis=1)[order], period=2 * np.pi)


def _nipple(distance: Array, width: float) -> Array:
    """Relative height of the nipple: half at half its width, a rounded top, and soft shoulders."""
    return 1 / (1 + (2 * distance / width) ** 6)


def _areola(form: Form, offset: Array, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Membership of each point in areola, nipple and Montgomery bumps : (n,) from 0 to 1, and their added height, mm."""
    distance, theta = np.hypot(*offset.T), np.arctan2(offset[:, 1], offset[:, 0])
    order = np.arange(2, 9)
    waves = np.cos(theta[:, None] * order + rng.uniform(0, 2 * np.pi, order.size))
    border_wobble = 0.014  # relative standard deviation of each of the border's harmonics
    border = form.areola_width / 2 * (1 + waves @ rng.normal(0, border_wobble, order.size))
    areola_edge_mm = 3.5  # over which the areola passes into the skin
    areola = _smoothstep((border - distance) / areola_edge_mm + 0.5)
    crease = np.cos(theta[:, None] * [2, 3, 5] + rng.uniform(0, 2 * np.pi, 3)).sum(axis=1)
    nipple_crease = 0.06  # relative, of each of three harmonics around the nipple
    uneven = 1 + nipple_crease * crease * np.minimum(1, distance / form.nipple_width)  # none in the middle, where theta jumps
    nipple = _nipple(distance * uneven, form.nipple_width)

    bumps, raised = np.zeros(len(offset)), form.areola_height * areola + form.nipple_height * nipple
    sector = 2 * np.pi / max(form.montgomery_bumps, 1)
    montgomery_height_mm = (0.25, 0.55)
    montgomery_radius_mm = (0.9, 1.3)  # standard deviation of a Gaussian bump
    for k in range(form.montgomery_bumps):
        turn = sector * (k + rng.uniform(-0.35, 0.35))
        away = rng.uniform(0.5, 0.82) * form.areola_width / 2
        middle = away * np.array([np.cos(turn), np.sin(turn)])
        bump = np.exp(-0.5 * (np.linalg.norm(offset - middle, axis=1) / rng.uniform(*montgomery_radius_mm)) ** 2)
        raised += rng.uniform(*montgomery_height_mm) * bump
        bumps = np.maximum(bumps, bump)
    return areola, nipple, bumps, raised


def _fit(vertices: Array, size: tuple[float, float, float]) -> Array:
    """Stretch by the last percent to the exact size, centred on the origin and standing on z = 0."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    fitted = (vertices - (low + high) / 2) * (np.array(size) / (high - low))
    fitted[:, 2] += size[2] / 2
    return fitted


def _smoothstep(x: Array) -> Array:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
