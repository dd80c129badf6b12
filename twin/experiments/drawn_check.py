"""Checks of drawn rigs: what detectors would find of a rig that is as calibrated, or of which one part has moved.

A rig is drawn from a calibration and its covariance, so that each has another error of it, and the drift that is usual. Film,
fringes and the bottom's echoes are drawn from the true rig, by its full models; the software has the calibration alone.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.estimation.covariance import root
from recon.geometry import camera_jacobian, rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import MOTION
from recon.geometry.circle_outline import ellipses_of
from recon.model import circle_layout, tracks
from recon.model.calibration import Uncertainty, moved
from recon.model.rig import Target
from recon.model.tracks import Track
from recon.rig_check import bottom_equations
from recon.rig_check.ball_bar import COMMON_PX, SHARED, BallBar
from recon.rig_check.bottom_equations import Lines
from recon.rig_check.fringe_matches import FLOOR_PX, MOST, WINDOW_NOISE
from recon.rig_check.optics_equations import CAMERAS, PROJECTOR, Matches, points_by_light
from recon.tracking.pose import aligned
from recon.tracking.pose_fit import Sighting, meet

Array = NDArray[np.float64]
Devices = Mapping[str, Camera]

PAIRS = 40  # of the film: as many as `sonotwin check` takes
REACH_MM, DEPTHS_MM, TILT_DEG = (50.0, 40.0), (606.0, 713.0), 20.0  # of the target in it
GROUND_MM, HEIGHT_MM, WIDTH_MM = 700.0, 45.0, 45.0  # of a mound under the fringes
VIEW_PX = 60  # that the points keep from camera 1's border
WINDOW_PX = 2.0  # to both sides, over which a map's derivatives are taken
BOTTOM_MM = 700.0  # z of the tank's bottom
SWINGS_HZ, ROCK_DEG, ROLL_DEG = (0.37, 0.23, 0.11), 20.0, 75.0  # of tilts forward and sideways, and of the roll
BOB_MM, BOB_HZ, SCANNER_HZ = 6.0, 0.35, 20.0
ROW_PX = 0.3  # standard deviation of the bottom's row


class Clocks(NamedTuple):
    """The scanner's stamps."""

    lag_s: float
    jitter_s: float = 0.002


def drawn_rig(cameras: Devices, known: Uncertainty, rng: np.random.Generator) -> dict[str, Camera]:
    """The true devices of a calibration that errs as its covariance says."""
    errors = root(known.covariance)
    return moved(cameras, known.names, errors @ rng.standard_normal(errors.shape[1]))


def turned(devices: Devices, rng: np.random.Generator, device: str, angle_deg: float) -> dict[str, Camera]:
    """Devices of which one has turned about its centre, about an axis of any direction."""
    axis = rng.standard_normal(3)
    turn = np.deg2rad(angle_deg) * axis / np.linalg.norm(axis)
    camera = devices[device]
    place = rigid.from_rotation_vector(turn, np.zeros(3)) @ camera.camera_from_world
    step = rigid.difference(camera.camera_from_world, place)
    return {**devices, device: camera_jacobian.moved(camera, MOTION, step)}


def shifted(devices: Devices, device: str, shift_mm: Array) -> dict[str, Camera]:
    """Devices of which one has been shifted : (3,) mm along its own axes."""
    return {**devices, device: camera_jacobian.moved(devices[device], MOTION, np.concatenate([np.zeros(3), -shift_mm]))}


def drawn_film(
    true: Devices, known: Devices, printed: Target, sigma_px: float, rng: np.random.Generator, count: int = PAIRS
) -> list[tuple[Sighting, Sighting]]:
    """Pairs of frames of a target that is moved about, as both cameras see it."""
    pairs, circles = [], circle_layout.circles(printed)
    while len(pairs) < count:
        turn = Rotation.from_rotvec(np.deg2rad(TILT_DEG) * rng.uniform(-1, 1, 2) @ np.eye(2, 3))
        facing = turn * Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)])
        middle = np.append(rng.uniform(-1, 1, 2) * REACH_MM, rng.uniform(*DEPTHS_MM))
        pose = rigid.transform(facing.as_matrix(), middle)
        views = []
        for name in CAMERAS:
            centres, shapes = ellipses_of(true[name], pose, *circles)
            inside = ((centres > 40) & (centres < np.array(true[name].size) - 40)).all()
            seen = centres + sigma_px * rng.standard_normal(centres.shape)
            views.append((inside, Sighting(known[name], seen, np.tile(sigma_px**2 * np.eye(2), (len(seen), 1, 1)), shapes)))
        if all(inside for inside, _ in views):
            pairs.append((views[0][1], views[1][1]))
    return pairs


def measured(printed: Target, sigma_mm: float, rng: np.random.Generator) -> Target:
    """A target as it was measured, each of its lengths to a standard deviation."""
    lengths = circle_layout.lengths(printed)
    found = circle_layout.with_lengths(printed, lengths + sigma_mm * rng.standard_normal(len(lengths)))
    variances = tuple(tuple(row) for row in (sigma_mm**2 * np.eye(len(lengths))).tolist())
    return found.model_copy(update={"covariance_mm2": variances})


def drawn_matches(true: Devices, known: Devices, axes: tuple[int, ...], sigma_px: float, rng: np.random.Generator) -> Matches:
    """Points of a mound under fringes along some axes, as windows of both cameras' maps show them.

    sigma_px : of a pixel of a map, in projector px. A window's pixels err each by itself; a floor more is claimed: on two
        rendered breasts residuals are 0.9 of what is claimed.
    """
    sigma_px *= WINDOW_NOISE
    claimed = float(np.hypot(FLOOR_PX, sigma_px))
    width, height = known["cam1"].size
    pixels = rng.uniform([VIEW_PX, VIEW_PX], [width - VIEW_PX, height - VIEW_PX], (4 * MOST, 2))
    first = _shown(true, "cam1", pixels)[:, list(axes)]
    first = first + sigma_px * rng.standard_normal(first.shape)
    seen_at = known["cam2"].project(points_by_light(pixels, first, axes, known))
    exact = _shown(true, "cam2", seen_at)
    inside = ((seen_at > VIEW_PX) & (seen_at < np.array(known["cam2"].size) - VIEW_PX)).all(axis=1)
    inside &= ((exact > 0) & (exact < np.array(known[PROJECTOR].size) - 1)).all(axis=1)
    chosen = np.flatnonzero(inside)[:MOST]
    pixels, first, seen_at, second = pixels[chosen], first[chosen], seen_at[chosen], exact[chosen][:, list(axes)]
    steps = WINDOW_PX * np.arange(-1, 2)
    near = np.array([[_shown(true, "cam2", seen_at + np.array([x, y]))[:, list(axes)] for y in steps] for x in steps])
    gradient = np.stack([near[2, 1] - near[0, 1], near[1, 2] - near[1, 0]], axis=-1) / (2 * WINDOW_PX)
    across, down = (near[2, 1] - 2 * second + near[0, 1], near[1, 2] - 2 * second + near[1, 0])
    turned = (near[2, 2] - near[2, 0] - near[0, 2] + near[0, 0]) / 4
    bend = np.stack([across, turned, turned, down], axis=-1).reshape(*second.shape, 2, 2) / WINDOW_PX**2
    second = second + sigma_px * rng.standard_normal(second.shape)
    sigma = np.full((len(pixels), 2, len(axes)), claimed)
    return Matches(pixels, first, seen_at, second, gradient, bend, sigma, axes)


def drawn_bar(true: Devices, centres_mm: Array, ball_mm: float, sigma_px: float, rng: np.random.Generator) -> BallBar:
    """Points of two balls about centres : (2, 3) mm, as camera 1 and the fringes show them; neighbours share their noise."""
    camera, pixels, shown, alike = true["cam1"], [], [], COMMON_PX * rng.standard_normal()
    for centre in centres_mm:
        middle, radius = camera.project(centre[None])[0], 0.7 * ball_mm / 2 * camera.matrix[0, 0] / centre[2]
        disc = rng.uniform(-1, 1, (1000, 2))
        seen = np.repeat(middle + radius * disc[np.hypot(*disc.T) < 1], SHARED, axis=0)
        rays = camera.rays(seen)
        along = rays @ (centre - camera.centre)
        off = np.sum((centre - camera.centre) ** 2) - along**2
        places = camera.centre + (along - np.sqrt((ball_mm / 2) ** 2 - off))[:, None] * rays
        pixels.append(seen)
        noise = np.repeat(rng.standard_normal((len(seen) // SHARED, 1)), SHARED, axis=0)
        shown.append(true[PROJECTOR].project(places)[:, :1] + sigma_px * noise + alike)
    return BallBar((pixels[0], pixels[1]), (shown[0], shown[1]), (0,))


def _shown(true: Devices, name: str, pixels: Array) -> Array:
    """Projector coordinates : (m, 2) px that a camera's pixels : (m, 2) see on the mound."""
    camera = true[name]
    rays, depth = camera.rays(pixels), np.full(len(pixels), GROUND_MM)
    for _ in range(20):
        x, y, z = (camera.centre + depth[:, None] * rays).T
        swell = HEIGHT_MM * np.exp(-(x**2 + y**2) / (2 * WIDTH_MM**2))
        across = (x * rays[:, 0] + y * rays[:, 1]) / WIDTH_MM**2 * swell
        depth = depth + (GROUND_MM - swell - z) / (rays[:, 2] - across)
    return true[PROJECTOR].project(camera.centre + depth[:, None] * rays)


def led_over_bottom(middle_mm: Array, seconds: float, rate_hz: float, rng: np.random.Generator) -> Track:
    """Poses `world_from_image` of a probe that is rolled, tilted to all sides and moved up and down, from 0 ns."""
    times = np.arange(int(seconds * rate_hz) + 1) / rate_hz
    phases = rng.uniform(0, 2 * np.pi, 4)
    uneven = times + 0.4 * np.sin(0.9 * times + phases[3])
    tilt, lean, roll = (np.sin(2 * np.pi * hz * uneven + phase) for hz, phase in zip(SWINGS_HZ, phases, strict=False))
    turns = Rotation.from_euler("YXZ", np.column_stack([ROLL_DEG * roll, ROCK_DEG * tilt, ROCK_DEG * lean]), degrees=True)
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = upright @ turns.as_matrix()
    poses[:, :3, 3] = middle_mm
    poses[:, 2, 3] += BOB_MM * np.sin(2 * np.pi * BOB_HZ * uneven)
    return Track(np.rint(times * 1e9).astype(np.int64), poses)


def drawn_track(true: Devices, known: Devices, target: Target, path: Track, sigma_px: float, rng: np.random.Generator) -> Track:
    """Poses of a target that is led along a path `world_from_target`, from where both cameras' rays of its circles meet.

    So they are as uncertain as the tracker's, and made in a hundredth of the time.
    """
    model = circle_layout.circle_centres(target)
    points = np.einsum("nij,kj->nki", path.poses[:, :3, :3], model) + path.poses[:, None, :3, 3]
    exact = [true[name].project(points.reshape(-1, 3)) for name in CAMERAS]
    noisy = [seen + sigma_px * rng.standard_normal(seen.shape) for seen in exact]
    still, moved = (_met([known[name] for name in CAMERAS], seen, model) for seen in (exact, noisy))
    errors = np.stack([rigid.difference(first, second) for first, second in zip(still, moved, strict=True)])
    return Track(path.times, moved, np.tile(errors.T @ errors / len(errors), (len(errors), 1, 1)))


def _met(cameras: list[Camera], seen: list[Array], model: Array) -> Array:
    """Poses : (n, 4, 4) of a model : (3, 3) mm whose points both cameras see at (3 n, 2) px."""
    return np.stack([aligned(model, points) for points in meet(cameras, seen)[0].reshape(-1, 3, 3)])


def drawn_lines(path: Track, scale: Array, size: tuple[int, int], clocks: Clocks, rng: np.random.Generator) -> Lines:
    """The bottom in B-scans along a path, stamped by the scanner's clock."""
    taken = path.times[0] + np.arange(int((path.times[-1] - path.times[0]) * 1e-9 * SCANNER_HZ)) * int(1e9 / SCANNER_HZ)
    poses, columns = tracks.at(path, taken), bottom_equations.columns(size)
    starts = np.einsum("ni,k->nki", poses[:, :3, 0], columns * scale[0]) + poses[:, None, :3, 3]
    rows = (BOTTOM_MM - starts[..., 2]) / (poses[:, None, 2, 1] * scale[1])
    rows = rows + ROW_PX * rng.standard_normal(rows.shape)
    pixels = np.stack([np.broadcast_to(columns, rows.shape), rows], axis=-1)
    stamps = taken + np.rint(1e9 * (clocks.lag_s + clocks.jitter_s * rng.standard_normal(len(taken)))).astype(np.int64)
    return Lines(stamps, pixels)


def bent(target_from_image: Array, middle_mm: Array, way_mm: float, rng: np.random.Generator) -> Array:
    """A bracket that was turned about its root at the target, so that the middle of the image : (3,) mm moves by a way."""
    arm = rigid.apply(target_from_image, middle_mm)
    axis = np.cross(arm, rng.standard_normal(3))
    turn = axis / np.linalg.norm(axis) * way_mm / np.linalg.norm(arm)
    return rigid.from_rotation_vector(turn, np.zeros(3)) @ target_from_image
