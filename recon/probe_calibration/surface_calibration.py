"""Calibration of a tracked ultrasound probe by the points of a surface at rest: a flat wall, or a sphere of known radius.

Each B-scan shows a curve of the surface: of a wall a line, by two of its points, of a sphere an arc, by three. The places of
their pixels, `world_from_target_i @ target_from_image @ [sx u, sy v, 0, 1]`, lie on the surface, so each makes one equation: its
distance from the plane, or from the sphere's centre less the radius. Unknown are the six of `target_from_image`, sx, sy and three
of the surface (Prager et al. 1998 for the wall). All points of a frame share the error of its pose, so a frame's equations are
weighted by their full covariance.

**Which motion is best.** Only the part of a place along the surface's normal shows. Tilts about the array and in the image's
plane turn the normal in it; its slopes and its place are known by these, and distances give the scales. Of a wall, its distance
and the depth of all pixels are told apart by large tilts alone, by 1 - cos(tilt); a roll about the normal tells a tilt of the
wall from one of the probe. Of a sphere, places aside of its middle turn the normal as well, and an error of the radius goes into
the depth. Predicted errors (1 sigma, of the worst pixel's place) by 0.05 degrees and 0.05 mm of noise per axis:

    tilt, rock, roll     60 frames of a wall     100 of a wall     100 of a sphere, up to 8 mm aside
    6, 8, 90 deg                1.9                   1.3                        0.19
    20, 15, 60 deg              0.77                  0.56                       0.17
    40, 25, 90 deg              0.33                  0.26                       0.16

**A mirror.** A rough surface shines where the image's plane meets it. A smooth one shines where it is square to the beam, so its
echo comes from nearer the foot of the perpendicular: of a wall at a depth y that is tilted by t across the plane up to
y (1 - cos t) nearer, of a surface of curvature k up to 1 / (1 + k y) of that. The share of it is one more unknown.

**A thick slice.** A rough surface tilted across the slice by t is met over a range of depths, in which the beam gets wider
and weaker: the middle of its echo lies by c tan(t)^2 before the place where the image's plane meets it, c being some tenths of
a millimetre. So small a shift goes with the tilt as a wall's distance does, which makes a wall's depth unsure by some 2 c. It
is an unknown with a standard deviation, too.

Source of the wall: Prager, Rohling, Gee and Berman 1998, Rapid calibration for 3-D freehand ultrasound.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from recon.errors import InputError
from recon.estimation.covariance import inverse, propagate, whitening
from recon.estimation.equations import NormalEquations, Step
from recon.estimation.levenberg_marquardt import USUAL, Rules, Unreachable, descend
from recon.estimation.parameters import Blocks
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration, place_slopes
from recon.probe_calibration import lateness, movement, point_calibration, probe_checks
from recon.probe_calibration.lateness import Lateness
from recon.probe_calibration.movement import PROBE, FrameEquations, Movement
from recon.probe_calibration.point_calibration import MAX_FACTOR, MAX_RMS_MM, MIN_INLIERS, NAMED, Noise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Size = tuple[int, int]  # width, height, px

MIN_FRAMES = 10  # eleven unknowns and two of the echo's, by two or three numbers a frame
MIRROR, MIRROR_SIGMA = 0.5, 0.5  # share of a mirror beforehand
NEARER_SIGMA_MM = 0.25  # of an echo before the surface, tilted by 45 degrees; the twin's slice makes it 0.1 to 0.4 by depth
MOST_MIRROR, WIDEST = 10.0, 1e3  # share and mm/px, beyond which steps are too long
SHRUNK = 1e-5  # mm/px, of an image that shrank to a point, whatever the unit of the poses
ARM_MM = 50.0  # at which a wall's tilt counts in mm
SURFACE_MM = 0.02  # standard deviation of an echo from its surface, common to a frame: speckle, and the mirror's diffraction
ROUNDS = 20
GOOD = 1e-3  # chance of a good frame's residual beyond the gate
DIRECTIONS = 300  # of a wall's normal that are tried, on a half sphere
CLOSER_DEG = (3.0, 1.0, 0.3)  # between those about the best ones
REWEIGHTED, REWEIGHTED_MM = 5, 0.1  # rounds, and the distance below which all count alike
DRAWS = 50  # random sets of a sphere's frames; at 20 % outliers 0.8**10 = 11 % of them are clean
REFINED = 6  # starts that are refined, the best
REFINE = Rules(steps=8)  # of these, which need not converge
STEEPEST, FLATTEST = 0.95, 0.3  # sine of a tilt across the plane, at most; cosine of one between beam and normal, at least
LEAST, LEAST_LEVEL = 1e-12, 1e-3  # measured noise over the assumed: exact numbers have none
SURE, LIKELY = 5.0, 3.0  # standard deviations from which on another radius of a sphere is refused, or told
BENDS = 0.01  # of a radius, by which speckle on its slopes may bend all arcs alike
LIKELY_MM = 0.5  # from the surface, of points that are read rightly
LAGS_S = np.array([-0.28, -0.24, -0.2, -0.16, -0.12, -0.08, -0.04, 0.04, 0.08, 0.12, 0.16, 0.2, 0.24, 0.28])  # tried
MOST_TRIED, REFINED_TRIED = 40, 2  # frames and starts, of a refusal
WEAK_DEG, WEAK_SHARE = 6.0, 0.08  # rms turns, and places as a share of the image, below which a motion is the cause


class Surface(Protocol):
    """A surface at rest in the world, by three unknowns and others of its kind."""

    @property
    def known(self) -> Array:
        """Information : (k,) on its unknowns beforehand; the first three are of its place, mm."""
        ...

    @property
    def departures(self) -> Array:
        """Differences : (k,) of its unknowns from what is known."""
        ...

    @property
    def curvature(self) -> float:
        """Towards the probe, 1/mm."""
        ...

    def moved(self, step: Array) -> Self:
        """After a step : (k,) of its unknowns."""
        ...

    def distances(self, places: Array) -> Array:
        """Distances : (...) mm of places : (..., 3), negative behind it."""
        ...

    def normals(self, places: Array) -> Array:
        """Directions : (..., 3) in which the distance grows."""
        ...

    def slopes(self, places: Array) -> Array:
        """Derivatives : (..., k) of the distances by the unknowns."""
        ...

    def turns(self, places: Array, directions: Array) -> tuple[Array, Array]:
        """Derivatives : (..., 3), (..., k) of the cosines between normals and directions : (..., 3), by place and unknowns."""
        ...


@dataclass(frozen=True)
class Wall:
    """A plane."""

    normal: Array  # (3,) towards the probe
    middle: Array  # (3,) mm, on it

    @property
    def known(self) -> Array:
        """Nothing."""
        return np.zeros(3)

    @property
    def departures(self) -> Array:
        """From nothing that is known."""
        return np.zeros(3)

    @property
    def curvature(self) -> float:
        """None."""
        return 0.0

    @property
    def across(self) -> Array:
        """Two directions : (2, 3) in it."""
        first = np.cross(self.normal, np.eye(3)[np.abs(self.normal).argmin()])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)])

    def moved(self, step: Array) -> "Wall":
        """After tilts, mm at ARM_MM along each direction in it, and a shift along the normal."""
        normal = self.normal - step[:2] / ARM_MM @ self.across
        return Wall(normal / np.linalg.norm(normal), self.middle + step[2] * self.normal)

    def distances(self, places: Array) -> Array:
        """Above the plane."""
        return (places - self.middle) @ self.normal

    def normals(self, places: Array) -> Array:
        """The same everywhere."""
        return np.broadcast_to(self.normal, places.shape)

    def slopes(self, places: Array) -> Array:
        """By both tilts and the shift."""
        along = (places - self.middle) @ self.across.T / ARM_MM
        return np.concatenate([-along, -np.ones_like(along[..., :1])], axis=-1)

    def turns(self, places: Array, directions: Array) -> tuple[Array, Array]:
        """By the tilts alone."""
        along = directions @ self.across.T / ARM_MM
        return np.zeros_like(places), np.concatenate([-along, np.zeros_like(along[..., :1])], axis=-1)


@dataclass(frozen=True)
class Sphere:
    """A sphere of nearly known radius."""

    centre: Array  # (3,) mm
    radius: float  # mm
    given: tuple[float, float]  # radius and its standard deviation, mm

    @property
    def known(self) -> Array:
        """Of the radius."""
        return np.array([0, 0, 0, self.given[1] ** -2])

    @property
    def departures(self) -> Array:
        """Of the radius."""
        return np.array([0, 0, 0, self.radius - self.given[0]])

    @property
    def curvature(self) -> float:
        """Of the near side."""
        return 1 / self.radius

    def moved(self, step: Array) -> "Sphere":
        """After a shift, and a change of the radius."""
        return replace(self, centre=self.centre + step[:3], radius=max(self.radius + float(step[3]), 0.1))

    def distances(self, places: Array) -> Array:
        """Outside of it."""
        return np.linalg.norm(places - self.centre, axis=-1) - self.radius

    def normals(self, places: Array) -> Array:
        """Away from the centre."""
        arms = places - self.centre
        return arms / np.maximum(np.linalg.norm(arms, axis=-1, keepdims=True), LEAST)

    def slopes(self, places: Array) -> Array:
        """By the centre and the radius."""
        normals = self.normals(places)
        return np.concatenate([-normals, -np.ones_like(normals[..., :1])], axis=-1)

    def turns(self, places: Array, directions: Array) -> tuple[Array, Array]:
        """By the place from the centre."""
        normals, distance = self.normals(places), np.linalg.norm(places - self.centre, axis=-1, keepdims=True)
        by_place = directions - (directions * normals).sum(axis=-1, keepdims=True) * normals
        by_place /= np.maximum(distance, LEAST)
        return by_place, np.concatenate([-by_place, np.zeros_like(distance)], axis=-1)


@dataclass(frozen=True)
class CurveSightings:
    """A curve in n frames, by k points of each."""

    poses: Array  # (n, 4, 4) world_from_target, mm
    pixels: Array  # (n, k, 2) px
    row_covariance: Array  # (n, k, k) px^2, of their rows
    pose_covariance: Array | None = None  # (n, 6, 6) as in recon.model.tracks: a turn (rad) after the pose's own, a shift (mm)
    pose_rates: Array | None = None  # (n, 4, 4) change of the poses a second, by which a lag of the B-scans moves them back
    lag_sigma_s: float = 0.0  # s, standard deviation of the lag

    def of(self, chosen: NDArray) -> "CurveSightings":
        """Those of some frames, by number or mask."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "lag_sigma_s"}
        parts = {name: None if value is None else value[chosen] for name, value in values.items()}
        return CurveSightings(**parts, lag_sigma_s=self.lag_sigma_s)


@dataclass(frozen=True)
class _Estimate:
    """The unknowns."""

    target_from_image: Array  # (4, 4)
    scale: Array  # (2,) mm/px
    surface: Surface
    mirror: float = 0.0  # share
    nearer_mm: float = 0.0  # shift of an echo by the slice's thickness, at 45 degrees

    def moved(self, step: Step) -> "_Estimate":
        """After a step of `_unknowns`; `Unreachable` where no image can be."""
        scale, probe, surface, (mirror, nearer) = _unknowns(self.surface).split(step.shared)
        share = self.mirror + float(mirror)
        if np.abs(self.scale + scale).max() > WIDEST or np.abs(probe[3:]).max() > rigid.FARTHEST_MM or abs(share) > MOST_MIRROR:
            raise Unreachable("a step that leads out of all images")
        pose = rigid.moved(self.target_from_image, probe)
        return _Estimate(pose, self.scale + scale, self.surface.moved(surface), share, self.nearer_mm + float(nearer))

    def axes(self, poses: Array) -> Array:
        """The image's axes : (n, 3, 3) in the world, columns."""
        return poses[:, :3, :3] @ self.target_from_image[:3, :3]

    def points(self, frames: CurveSightings) -> Array:
        """Places : (n, k, 3) mm of the points' pixels in the target's frame."""
        return (frames.pixels * self.scale) @ self.target_from_image[:3, :2].T + self.target_from_image[:3, 3]

    def arms(self, frames: CurveSightings) -> Array:
        """Vectors : (n, k, 3) mm, along the world's axes, from the target's origin to the points' pixels."""
        return self.points(frames) @ np.swapaxes(frames.poses[:, :3, :3], 1, 2)

    def places(self, frames: CurveSightings) -> Array:
        """Places : (n, k, 3) mm of the points' pixels in the world."""
        return self.arms(frames) + frames.poses[:, None, :3, 3]


@dataclass(frozen=True)
class _Linear:
    """Distances of all points from the surface, and their derivatives."""

    distances: Array  # (n, k) mm
    by_place: Array  # (n, k, 3)
    slopes: Array  # (n, k, g) by `_unknowns`
    by_poses: Array  # (n, k, k) mm^2, covariance by noise of the poses
    covariance: Array  # (n, k, k) mm^2, with all other


def _unknowns(surface: Surface) -> Blocks:
    """The first as `recon.model.probe.NAMES`."""
    return Blocks({"scale": 2, "probe": 6, "surface": len(surface.known), "echo": 2})


def _known(estimate: _Estimate) -> tuple[Array, Array]:
    """Information : (g,) on the unknowns beforehand, and the differences : (g,) of an estimate from it."""
    blocks = _unknowns(estimate.surface)
    known, departures = np.zeros(len(blocks)), np.zeros(len(blocks))
    known[blocks["surface"]], departures[blocks["surface"]] = estimate.surface.known, estimate.surface.departures
    known[blocks["echo"]] = MIRROR_SIGMA**-2, NEARER_SIGMA_MM**-2
    departures[blocks["echo"]] = estimate.mirror - MIRROR, estimate.nearer_mm
    return known, departures


def _linear(estimate: _Estimate, frames: CurveSightings, noise: Noise) -> _Linear:
    """The equations at an estimate, of pixels that are as much deeper as a mirror's echo comes from behind them."""
    surface, axes = estimate.surface, estimate.axes(frames.poses)
    across = np.broadcast_to(axes[:, None, :, 2], (*frames.pixels.shape[:2], 3))
    places = estimate.places(frames)
    sine = np.clip((surface.normals(places) * across).sum(axis=-1), -STEEPEST, STEEPEST)
    cosine, depth = np.sqrt(1 - sine**2), frames.pixels[..., 1] * estimate.scale[1]
    reach = depth / (1 + surface.curvature * depth)
    deeper = reach * (1 - cosine)
    down = np.minimum((surface.normals(places) * axes[:, None, :, 1]).sum(axis=-1), -FLATTEST)
    slope = np.minimum((sine / down) ** 2, FLATTEST**-2)
    behind = frames.pixels + ((estimate.mirror * deeper + estimate.nearer_mm * slope) / estimate.scale[1])[..., None] * [0, 1]
    by_place, by_surface = surface.turns(places, across)
    shown = replace(frames, pixels=behind)
    arms = estimate.arms(shown)
    places = arms + frames.poses[:, None, :3, 3]
    normals = surface.normals(places)
    along = (normals * axes[:, None, :, 1]).sum(axis=-1)
    (n, k), blocks = places.shape[:2], _unknowns(surface)
    by_sine = (along * estimate.mirror * reach * sine / cosine)[..., None]
    by_probe = place_slopes(estimate.target_from_image, estimate.scale, behind.reshape(-1, 2)).reshape(n, k, 3, -1)
    slopes = np.zeros((n, k, len(blocks)))
    slopes[..., : len(NAMES)] = np.einsum("nki,nij,nkjg->nkg", normals + by_sine * by_place, frames.poses[:, :3, :3], by_probe)
    turned = by_sine * (np.cross(across, normals) @ frames.poses[:, :3, :3])
    slopes[..., blocks["probe"].start : blocks["probe"].start + 3] += turned
    slopes[..., 1] -= along * estimate.mirror * deeper * surface.curvature * reach / estimate.scale[1]
    slopes[..., blocks["surface"]] = surface.slopes(places) + by_sine * by_surface
    slopes[..., blocks["echo"]] = along[..., None] * np.stack([deeper, slope], axis=-1)
    pose = noise.of_pose if frames.pose_covariance is None else frames.pose_covariance
    by_poses = propagate((normals[..., None, :] @ rigid.slopes(arms))[..., 0, :], pose)
    by_row = along * estimate.scale[1]
    covariance = by_poses + by_row[..., None] * frames.row_covariance * by_row[:, None] + SURFACE_MM**2
    return _Linear(surface.distances(places), normals, slopes, by_poses, covariance + point_calibration.FLOOR_MM**2 * np.eye(k))


def _whitened(estimate: _Estimate, frames: CurveSightings, noise: Noise) -> tuple[Array, Array]:
    """Slopes : (n, k, g) of the distances and these : (n, k), in standard deviations."""
    linear = _linear(estimate, frames, noise)
    both = whitening(linear.covariance) @ np.concatenate([linear.slopes, linear.distances[..., None]], axis=-1)
    return both[..., :-1], both[..., -1]


def _normal_equations(estimate: _Estimate, frames: CurveSightings, noise: Noise, level: float) -> tuple[NormalEquations, float]:
    """Normal equations and cost; no frame has unknowns of its own."""
    slopes, left = (each / level for each in _whitened(estimate, frames, noise))
    known, departures = _known(estimate)
    equations = NormalEquations.of_rows(slopes, np.zeros((*left.shape, 0)), -left)
    return equations.held(np.diag(known), departures), float(np.sum(left**2) + known @ departures**2)


def _fit(start: _Estimate, frames: CurveSightings, noise: Noise, level: float = 1.0, rules: Rules = USUAL) -> _Estimate:
    """Weighted least squares."""
    return descend(
        start, lambda estimate: _normal_equations(estimate, frames, noise, level), _Estimate.moved, rules=rules
    ).estimate


def _squared(estimate: _Estimate, frames: CurveSightings, noise: Noise) -> Array:
    """Squared normalised distances : (n,) of frames, chi-square with k degrees of freedom."""
    return (_whitened(estimate, frames, noise)[1] ** 2).sum(axis=1)


def _starts_of_wall(frames: CurveSightings) -> list[_Estimate]:
    """Starts by linear equations for many directions of the normal: on a half sphere, then closer and closer about the best."""
    step = np.arange(DIRECTIONS) + 0.5
    height, angle = step / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * step
    across = np.sqrt(1 - height**2)
    normals = np.column_stack([across * np.cos(angle), across * np.sin(angle), height])  # Fibonacci's lattice
    solution, misfit = _linear_of_walls(normals, frames)
    for closer in CLOSER_DEG:
        best = normals[np.argsort(misfit)[:REFINED]]
        aside = np.radians(closer) * np.stack(np.meshgrid(*2 * [np.arange(-2, 3)]), axis=-1).reshape(-1, 2)
        normals = np.concatenate([normal + aside @ Wall(normal, np.zeros(3)).across for normal in best])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        solution, misfit = _linear_of_walls(normals, frames)
    starts = []
    for k in np.argsort(misfit)[:REFINED]:
        a, b, place, (distance,) = np.split(solution[k], [3, 6, 9])
        scale = np.maximum(np.linalg.norm([a, b], axis=1), LEAST)
        pose = _posed(np.column_stack([a, b]) / scale, place)
        normal = normals[k] * (-1 if np.mean(frames.poses[:, :3, :3] @ pose[:3, 1] @ normals[k]) > 0 else 1)
        places = _Estimate(pose, scale, Wall(normal, distance * normals[k])).places(frames).reshape(-1, 3)
        middle = np.median(places, axis=0)
        starts.append(_Estimate(pose, scale, Wall(normal, middle + (distance - middle @ normals[k]) * normals[k])))
    return starts


def _linear_of_walls(normals: Array, frames: CurveSightings) -> tuple[Array, Array]:
    """Least sums of absolute distances, for g directions of a wall's normal : (g, 3), by reweighted least squares.

    With the normal n known, `n (R_i (u a + v b + t) + t_i) = d` is linear in a = sx x, b = sy y, t and d.

    Returns
    -------
    solution : (g, 10) of a, b, t and d
    misfit : (g,) px, the median distance by the smaller scale, for an image that shrinks to a point lies on many planes
    """
    turns, shifts = frames.poses[:, :3, :3], frames.poses[:, :3, 3]
    origin, ones = shifts.mean(axis=0), np.ones((len(normals), *frames.pixels.shape[:2], 1))
    inside = np.einsum("gj,njk->gnk", normals, turns)[:, :, None]  # the normals in the target's frame
    u, v = np.moveaxis(frames.pixels / 100, -1, 0)[..., None]  # columns of like length
    rows = np.concatenate([u * inside, v * inside, ones * inside, -ones], axis=-1).reshape(len(normals), -1, 10)
    right = -(ones[..., 0] * (normals @ (shifts - origin).T)[..., None]).reshape(len(normals), -1)
    solution, away = np.zeros((len(normals), 10)), np.ones_like(right)
    for _ in range(REWEIGHTED):
        weights = 1 / np.maximum(away, REWEIGHTED_MM)
        turned = np.swapaxes(rows * weights[..., None], 1, 2)
        information = turned @ rows
        ridge = 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(10)
        solution = np.linalg.solve(information + ridge, turned @ right[..., None])[..., 0]
        away = np.abs((rows @ solution[..., None])[..., 0] - right)
    solution[:, :6] /= 100
    solution[:, 9] += normals @ origin
    scale = np.linalg.norm(solution[:, :6].reshape(-1, 2, 3), axis=2).min(axis=1)
    return solution, np.median(away, axis=1) / np.maximum(scale, LEAST)


def _posed(columns: Array, place: Array) -> Array:
    """The rigid transform nearest to two columns : (3, 2), and a place."""
    left, _, right = np.linalg.svd(columns, full_matrices=False)
    x, y = (left @ right).T
    return rigid.transform(np.column_stack([x, y, np.cross(x, y)]), place)


def _starts_of_sphere(frames: CurveSightings, radius: tuple[float, float]) -> list[_Estimate]:
    """Starts by the arcs' tops: these are one point at rest, but for the radius along the beam and places beside the middle."""
    tops = _tops(frames.pixels)
    rng, n = np.random.default_rng(0), len(tops)
    sets = [np.arange(n), *(rng.permutation(n)[:MIN_FRAMES] for _ in range(DRAWS))]
    starts = []
    for chosen in sets:
        pose, scale, centre = point_calibration.closed_form(frames.poses[chosen], tops[chosen])
        pose = pose @ rigid.transform(np.eye(3), [0, -radius[0], 0])
        starts.append(_Estimate(pose, np.maximum(scale, LEAST), Sphere(centre, radius[0], radius)))
    return starts


def _tops(pixels: Array) -> Array:
    """Tops : (n, 2) px of parabolas through three points : (n, 3, 2)."""
    middle, half = pixels[:, 1, 0], np.maximum((pixels[:, 2, 0] - pixels[:, 0, 0]) / 2, LEAST)
    slope, bend = (pixels[:, 2, 1] - pixels[:, 0, 1]) / 2, pixels[:, [0, 2], 1].mean(axis=1) - pixels[:, 1, 1]
    away = np.clip(-slope / (2 * np.maximum(bend, LEAST)), -10, 10)
    return np.column_stack([middle + half * away, pixels[:, 1, 1] + slope * away + bend * away**2])


def _robust_start(frames: CurveSightings, radius: tuple[float, float] | None, noise: Noise, refined: int = REFINED) -> _Estimate:
    """Least median of squares over starts, the best few of which are refined on their better halves."""
    starts = _starts_of_wall(frames) if radius is None else _starts_of_sphere(frames, radius)
    medians = [float(np.median(np.abs(_linear(each, frames, noise).distances))) for each in starts]
    best = [_refined_on_half(starts[k], frames, noise) for k in np.argsort(medians)[:refined]]
    return min(best, key=lambda each: (each.scale.min() < SHRUNK, float(np.median(_squared(each, frames, noise)))))


def _refined_on_half(start: _Estimate, frames: CurveSightings, noise: Noise) -> _Estimate:
    """After two rounds of least squares on the better half of the frames."""
    keep = max(len(frames.poses) // 2 + 1, min(MIN_FRAMES, len(frames.poses)))
    for _ in range(2):
        away = np.abs(_linear(start, frames, noise).distances).max(axis=1)
        start = _fit(start, frames.of(np.argsort(away)[:keep]), noise, rules=REFINE)
    return start


def _without_outliers(start: _Estimate, frames: CurveSightings, noise: Noise) -> tuple[_Estimate, Mask, float]:
    """Least squares on the frames within the gate, until these are the same again, and measured noise over the assumed."""
    points = frames.pixels.shape[1]
    gate, median = (float(chdtri(points, chance)) for chance in (GOOD, 0.5))
    estimate, inliers, level = start, np.ones(len(frames.poses), bool), 1.0
    for round_ in range(ROUNDS):
        squared = _squared(estimate, frames, noise)
        scale = max(float(np.median(squared[inliers] if round_ else squared)) / median, LEAST_LEVEL**2)
        inside = squared <= gate * scale
        if round_ and ((inside == inliers).all() or inside.sum() < MIN_FRAMES):
            break
        inliers = inside
        estimate = _fit(estimate, frames.of(inliers), noise, np.sqrt(scale))
        level = _level(estimate, frames.of(inliers), noise)
    estimate = _fit(estimate, frames.of(inliers), noise, level)
    return estimate, inliers, _level(estimate, frames.of(inliers), noise)


def _level(estimate: _Estimate, frames: CurveSightings, noise: Noise) -> float:
    """Measured noise over the assumed, with the freedom that what is known leaves."""
    left = _whitened(estimate, frames, noise)[1]
    unknowns = len(NAMES) + 3  # the echo's and a radius are all but known
    return max(float(np.sqrt((left**2).sum() / max(left.size - unknowns, 1))), LEAST_LEVEL)


@dataclass(frozen=True)
class SurfaceAdjustment:
    """Adjusted values, their uncertainty, and the residuals."""

    calibration: ProbeCalibration
    surface: Surface
    residuals: Array  # (n, k) mm, from the surface
    chi: Array  # (n,) length of the residuals over their standard deviations; sqrt(k) for a typical frame
    outliers: Mask  # (n,)
    noise_factor: float  # measured noise over the assumed
    mirror: tuple[float, float]  # share of a mirror in the echo, and its standard deviation
    radius: tuple[float, float]  # mm, of a sphere, by the arcs alone, and its standard deviation; NaN of a wall
    held_out_mm: float  # RMS of frames of half of them, by the other half
    late: Lateness | None = None  # of the B-scans, beyond the lag of the poses; None without times
    moved: Movement | None = None  # of the probe or the phantom, which the covariance allows for
    persistence: float = 1.0  # frames that count as one in the covariance, as residuals of neighbours are alike

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the points from the surface, outliers left out."""
        return _rms(self.residuals[~self.outliers])

    @property
    def distances_mm(self) -> Array:
        """Root mean square distances : (n,) of a frame's points."""
        return np.sqrt((self.residuals**2).mean(axis=1))

    @property
    def normalised(self) -> Array:
        """The same : (n,) over their standard deviations."""
        return self.chi / np.sqrt(self.residuals.shape[1])

    def doubts(self) -> Iterator[str]:
        """What is unusual in a way that a mistake is."""
        if isinstance(self.surface, Sphere) and _off(self.radius, self.surface.given, LIKELY):
            radius, sigma = self.radius
            yield f"by arcs and motion the sphere's radius is {radius:.2f} ± {sigma:.2f} mm, given {self.surface.given[0]:g}"
        if self.moved is not None:
            yield _described(self.moved)
        if self.late is not None and self.late.shown:
            yield _described_lag(self.late)


def _off(found: tuple[float, float], given: tuple[float, float], sigmas: float) -> bool:
    """Whether a radius is another than given, by some standard deviations of both, and more than speckle bends arcs."""
    return abs(found[0] - given[0]) > sigmas * np.hypot(found[1], given[1]) + BENDS * given[0]


def _has_extent(estimate: _Estimate) -> bool:
    """Whether the image is as large as any scanner's; else it shrank to a point, which poses alone may keep on a surface."""
    return bool((estimate.scale >= probe_checks.SCALES[0]).all())


def _rms(distances: Array) -> float:
    return float(np.sqrt((distances**2).mean()))


def _described_lag(late: Lateness) -> str:
    return f"{late.corrected}, or hold still"


def _described(moved: Movement) -> str:
    if moved.what == PROBE:
        return moved.described
    return f"the phantom moved by {moved.shift_mm:.2f} mm between the first frame and the last: a phantom or tank that was pushed"


def calibrate(
    sightings: CurveSightings,
    size: Size,
    radius: tuple[float, float] | None = None,
    noise: Noise | None = None,
    expected: Array | None = None,
    max_sigma_mm: float = probe_checks.MAX_SIGMA_MM,
    numbers: NDArray[np.int64] | None = None,
) -> SurfaceAdjustment:
    """Calibrate a probe from poses and the points of a surface at rest.

    Parameters
    ----------
    size : (width, height) px
        Of the B-scans.
    radius : (radius, sigma) mm
        Of a sphere, and its standard deviation; None of a wall.
    noise : Noise
        For poses without a covariance. Only its proportions matter: the level is measured.
    expected : (4, 4)
        `target_from_image` as designed, as of `point_calibration.calibrate`.
    max_sigma_mm : float
        Standard deviation of a pixel's place beyond which the outcome is refused.
    numbers : (n,)
        Of the frames, for messages; from 0 on without them.

    Raises
    ------
    InputError
        If the frames are too few, contradict each other, or do not determine the calibration; or the outcome can't be right.
    """
    count, noise = len(sightings.poses), noise or Noise()
    if count < MIN_FRAMES:
        raise InputError(f"sightings: expected at least {MIN_FRAMES} frames with a pose and the surface, found {count}")
    probe_checks.poses(sightings.poses)
    start = _robust_start(sightings, radius, noise)
    estimate, inliers, level = _without_outliers(start, sightings, noise)
    used = sightings.of(inliers)
    rms = _rms(_linear(estimate, used, noise).distances)
    if level > MAX_FACTOR or rms > MAX_RMS_MM or inliers.mean() < MIN_INLIERS or not _has_extent(estimate):
        _say_why(estimate, sightings, radius, noise, (level, rms, float(inliers.mean())), numbers)
    blocks = _unknowns(estimate.surface)
    place = slice(blocks["surface"].start, blocks["surface"].start + 3)
    slopes, left = (each / level for each in _whitened(estimate, sightings, noise))
    equations = FrameEquations(slopes, left, blocks["probe"], place, _known(estimate)[0])
    spread = inverse(_information(equations, inliers))
    by_arcs = _radius(estimate, spread)
    late = None if sightings.pose_rates is None else _lateness(estimate, used, noise, level)
    if radius is not None and _off(by_arcs, radius, SURE):
        _refuse_reading(sightings, radius, noise, min(LIKELY_MM, rms))
        found = f"{radius[0]:g} mm, where the arcs and the motion make it {by_arcs[0]:.2f} ± {by_arcs[1]:.2f} mm"
        raise InputError(f"sphere_radius_mm: expected the sphere's radius, found {found}: its diameter, another unit or sphere?")
    moved = movement.find(equations, inliers)
    solved, inliers = inliers, inliers if moved is None else moved.frames
    alike = movement.alike(slopes[inliers], left[inliers], equations.known) if moved is None else moved.alike
    step, covariance = movement.average(equations, solved, inliers, alike=alike)
    estimate = estimate.moved(Step(step, np.zeros((0, 0))))
    covariance = covariance[: len(NAMES), : len(NAMES)].copy()
    if late is not None:
        covariance += sightings.lag_sigma_s**2 * np.outer(late.change, late.change)
    try:
        there, weak = sightings.of(inliers), _weak(estimate, sightings.of(inliers), size)
        middles = _Middles(there.poses, there.pixels.mean(axis=1))
        probe_checks.certainty(estimate.target_from_image, estimate.scale, covariance, middles, size, max_sigma_mm, weak)
    except InputError as error:
        also = _described_lag(late) if late is not None and late.shown else "" if moved is None else _described(moved)
        raise InputError(f"{error}; {also}" if also else str(error)) from None
    uncertainty = Uncertainty(NAMES, (covariance + covariance.T) / 2)
    calibration = ProbeCalibration(estimate.target_from_image, estimate.scale, uncertainty)
    probe_checks.outcome(calibration, size, expected)
    return SurfaceAdjustment(
        calibration,
        estimate.surface,
        _linear(estimate, sightings, noise).distances,
        np.sqrt(_squared(estimate, sightings, noise)) / level,
        ~inliers,
        level,
        (estimate.mirror, float(np.sqrt(spread[blocks["echo"], blocks["echo"]][0, 0]))),
        by_arcs,
        _held_out(estimate, sightings.of(inliers), noise, level),
        late,
        moved,
        alike,
    )


@dataclass(frozen=True)
class _Middles:
    """Of curves, for `probe_checks`."""

    poses: Array  # (n, 4, 4)
    pixels: Array  # (n, 2)


def _information(equations: FrameEquations, used: Mask) -> Array:
    """On the unknowns : (g, g), with what is known of them."""
    rows = equations.slopes[used].reshape(-1, equations.slopes.shape[-1])
    return rows.T @ rows + np.diag(equations.known)


def _radius(estimate: _Estimate, spread: Array) -> tuple[float, float]:
    """A sphere's radius without what is known of it, and its standard deviation; NaN of a wall."""
    surface = estimate.surface
    if not isinstance(surface, Sphere):
        return np.nan, np.nan
    place, (given, sigma) = _unknowns(surface)["surface"].stop - 1, surface.given
    whole, known = 1 / float(spread[place, place]), sigma**-2
    alone = max(whole - known, 1e-6 * known)
    return (whole * surface.radius - known * given) / alone, alone**-0.5


def _lateness(estimate: _Estimate, frames: CurveSightings, noise: Noise, level: float) -> Lateness:
    """Lag of the B-scans that the residuals of frames that aren't outliers show; a level of noise over the assumed."""
    assert frames.pose_rates is not None
    linear = _linear(estimate, frames, noise)
    whiten, rates = whitening(linear.covariance), frames.pose_rates
    motion = estimate.points(frames) @ np.swapaxes(rates[:, :3, :3], 1, 2) + rates[:, None, :3, 3]
    column = (whiten @ -(linear.by_place * motion).sum(axis=-1)[..., None])[..., 0] / level
    slopes, left = (each / level for each in _whitened(estimate, frames, noise))
    by_poses = float(np.trace(propagate(whiten, linear.by_poses), axis1=1, axis2=2).sum())
    counted = np.full(len(left), left.shape[1])
    return lateness.of_residuals(column, left, slopes, _known(estimate)[0], counted, level, by_poses)


def _weak(estimate: _Estimate, frames: CurveSightings, size: Size) -> dict[str, float]:
    """Parts of the motion over a surface in words, each with its size over that which determines a probe well."""
    places, axes = estimate.places(frames), estimate.axes(frames.poses)
    depth = float(frames.pixels[..., 1].mean(axis=1).std()) / size[1]
    weak = {f"nearly one distance from the surface, {100 * depth:.0f} % of the image (rms)": depth / WEAK_SHARE}
    if not isinstance(estimate.surface, Wall):
        turns, aside = probe_checks.turns(frames.poses)[1][1], float(frames.pixels[..., 0].mean(axis=1).std()) / size[0]
        weak[f"turns about one axis only, others {turns:.1f} deg (rms)"] = turns / WEAK_DEG
        weak[f"nearly one lateral position only, {100 * aside:.0f} % of the image (rms)"] = aside / WEAK_SHARE
        return weak
    normals = np.einsum("nki,nij->nkj", estimate.surface.normals(places), axes).mean(axis=1)
    array = axes[:, :, 0] @ estimate.surface.across.T @ [1, 1j]
    together = np.abs(np.mean(array / np.maximum(np.abs(array), LEAST)))  # 1 without any roll
    for name, value in (
        ("tilts about the array, out of the image's plane", np.arcsin(np.clip(normals[:, 2], -1, 1)).std()),
        ("tilts in the image's plane", np.arcsin(np.clip(normals[:, 0], -1, 1)).std()),
        ("rolls about the depth axis", np.sqrt(-2 * np.log(np.clip(together, LEAST, 1)))),
    ):
        weak[f"hardly any {name}, {np.degrees(value):.1f} deg (rms)"] = float(np.degrees(value)) / WEAK_DEG
    return weak


def _held_out(estimate: _Estimate, frames: CurveSightings, noise: Noise, level: float) -> float:
    """RMS, mm, of the points of odd frames by a calibration of the even ones, and the other way round; NaN of too few."""
    even = np.arange(len(frames.poses)) % 2 == 0
    if even.sum() < MIN_FRAMES or (~even).sum() < MIN_FRAMES:
        return np.nan
    left = []
    for used in (even, ~even):
        fitted = _fit(estimate, frames.of(used), noise, level)
        left.append(_linear(fitted, frames.of(~used), noise).distances)
    return _rms(np.concatenate(left))


def _say_why(
    estimate: _Estimate,
    frames: CurveSightings,
    radius: tuple[float, float] | None,
    noise: Noise,
    found: tuple[float, float, float],
    numbers: NDArray[np.int64] | None,
) -> None:
    """Refuse frames that don't show a surface at rest, and name the reading of the poses under which they would."""
    level, rms, agree = found
    what = _named(radius)
    away = np.sqrt((_linear(estimate, frames, noise).distances ** 2).mean(axis=1))
    _refuse_reading(frames, radius, noise, min(float(np.median(away)) / 4, MAX_RMS_MM) if _has_extent(estimate) else LIKELY_MM)
    names = np.arange(len(away)) if numbers is None else numbers
    farthest = ", ".join(f"frame {names[k]} by {away[k]:.2g} mm" for k in np.argsort(-away)[:NAMED])
    if not _has_extent(estimate):
        sx, sy = estimate.scale
        raise InputError(
            f"sightings: expected frames of {what} at rest, found that places of pixels don't matter: {sx:.2g} and {sy:.2g} mm/px"
        )
    noisy = f"residuals of {rms:.1f} mm (rms), {level:.1f} times the assumed noise, of the {100 * agree:.0f} % that agree"
    raise InputError(f"sightings: expected frames of {what} at rest, found {noisy}; farthest off: {farthest}")


def _named(radius: tuple[float, float] | None) -> str:
    return "a wall" if radius is None else f"a sphere of {radius[0]:g} mm"


def _refuse_reading(frames: CurveSightings, radius: tuple[float, float] | None, noise: Noise, most_mm: float) -> None:
    """Refuse a common mistake without which most points would lie within a distance from the surface."""
    some = np.unique(np.linspace(0, len(frames.poses) - 1, MOST_TRIED).astype(int))
    likely, least = "", most_mm
    for meaning, other in _readings(frames.of(some)):
        start = _robust_start(other, radius, noise, refined=REFINED_TRIED)
        misfit = float(np.median(np.abs(_linear(start, other, noise).distances)))
        if misfit < least and _has_extent(start):
            likely, least = meaning, misfit
    if likely:
        raise InputError(f"sightings: expected frames of {_named(radius)} at rest, found {likely}: read so, they are")


def _readings(frames: CurveSightings) -> Iterator[tuple[str, CurveSightings]]:
    """Common mistakes, each with the frames as they would be without."""
    for meaning, poses in probe_checks.readings(frames.poses).items():
        yield f"poses of {meaning}", replace(frames, poses=poses)
    for unit, length in probe_checks.POSE_UNITS.items():
        poses = frames.poses.copy()
        poses[:, :3, 3] *= length
        yield f"poses in {unit}", replace(frames, poses=poses)
    if frames.pose_rates is not None and np.abs(frames.pose_rates).any():
        for lag in LAGS_S:
            poses = np.stack([rigid.nearest(pose) for pose in frames.poses - lag * frames.pose_rates])
            yield f"B-scans {'late' if lag > 0 else 'early'} by about {abs(lag):.2f} s beyond lag_s", replace(frames, poses=poses)
