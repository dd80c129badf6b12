"""Frames of the target, drawn: rings by supersampling on the pixel grid, blurred by lens and motion, read by the rig's sensor."""

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of
from recon.geometry.ellipses import Ellipses
from recon.model import circle_layout

ELECTRONS = 7700 / 255  # a digital number
DARK_E = 11.0
BLACK_DN = 2.0
LENS_PX = 0.55  # standard deviation in focus, of the lens with a little defocus
SUBSAMPLES = 5  # a side
MARGIN_MM = 14.0  # of white about the discs' middles
BOARD = np.array([[-MARGIN_MM, -MARGIN_MM], [25 + MARGIN_MM, 40 + MARGIN_MM]])  # mm, corners in the target's frame


def reflectance(camera: Camera, poses, target, ground=0.25, black=0.04):
    """Mean over poses, of what a camera sees : (h, w), white board 1, without blur but the pixels' own extent and motion."""
    width, height = camera.size
    image = np.full((height, width), ground)
    corners = np.array([[x, y, 0.0] for x in BOARD[:, 0] for y in BOARD[:, 1]])
    seen = np.concatenate([camera.project(rigid.apply(place, corners)) for place in poses])
    left, top = np.clip(np.floor(seen.min(axis=0)).astype(int) - 3, 0, [width, height])
    right, bottom = np.clip(np.ceil(seen.max(axis=0)).astype(int) + 4, 0, [width, height])
    if right - left < 3 or bottom - top < 3:
        return image
    v, u = np.mgrid[top:bottom, left:right].astype(float)
    rays = camera.rays(np.stack([u, v], axis=-1))
    count = SUBSAMPLES if len(poses) == 1 else 2
    image[top:bottom, left:right] = np.mean(
        [_board(camera, rays, place, target, ground, black, count) for place in poses], axis=0
    )
    return image


def _board(camera, rays, world_from_target, target, ground, black, count):
    """Brightness : (h, w), by sub-pixels where an edge is near; elsewhere the whole pixel looks alike."""
    x, y = _on_board(camera, world_from_target, rays)
    slopes = np.array([np.gradient(axis) for axis in (x, y)])  # of x and y, by v and u
    scale = np.hypot(slopes[0, 1], slopes[0, 0]) / count
    reach = np.hypot(*slopes).sum(axis=0) / 2 + scale  # mm, from a pixel's middle to what counts for its corners

    def brightness(px, py, scale):
        inside = [np.clip((px - BOARD[0, 0]) / scale + 0.5, 0, 1), np.clip((BOARD[1, 0] - px) / scale + 0.5, 0, 1)]
        inside += [np.clip((py - BOARD[0, 1]) / scale + 0.5, 0, 1), np.clip((BOARD[1, 1] - py) / scale + 0.5, 0, 1)]
        ink = np.zeros_like(px)
        for cx, cy, _ in circle_layout.circle_centres(target):
            away = np.hypot(px - cx, py - cy)
            outer = np.clip((target.outer_diameter_mm / 2 - away) / scale + 0.5, 0, 1)
            ink += outer * np.clip((away - target.inner_diameter_mm / 2) / scale + 0.5, 0, 1)
        board = np.prod(inside, axis=0)
        return ground * (1 - board) + board * (1 - (1 - black) * ink)

    near = np.minimum(np.abs(x[..., None] - BOARD[:, 0]), np.abs(y[..., None] - BOARD[:, 1])).min(axis=-1) < reach
    for cx, cy, _ in circle_layout.circle_centres(target):
        away = np.hypot(x - cx, y - cy)
        for diameter in (target.outer_diameter_mm, target.inner_diameter_mm):
            near |= np.abs(away - diameter / 2) < reach
    total, part = brightness(x, y, scale), (np.arange(count) + 0.5) / count - 0.5
    places = [
        [axis[near] + dv * slope[0][near] + du * slope[1][near] for axis, slope in zip((x, y), slopes, strict=True)]
        for dv in part
        for du in part
    ]
    total[near] = sum(brightness(*place, scale[near]) for place in places) / count**2
    return total


def frame(camera, poses, target, white=100.0, rng=None, lens=LENS_PX, ground=0.25, light=None):
    """An 8-bit frame : (h, w) of poses : a list, over the exposure; noise if there is a generator, else float DN."""
    sharp = reflectance(camera, poses, target, ground)
    mean = white * gaussian_filter(sharp, lens, mode="nearest")
    if light is not None:
        mean = mean * light
    return mean + BLACK_DN if rng is None else read_out(mean, rng)


def read_out(mean, rng):
    """Shot, dark and fixed noise of the rig's sensor, black level, rounding and clipping, to 8 bits."""
    mean = np.asarray(mean, np.float32)
    electrons = np.maximum(mean * ELECTRONS * (1 + 0.008 * rng.standard_normal(mean.shape, np.float32)), 0)
    electrons = electrons + np.sqrt(electrons + DARK_E**2 + 8.0**2) * rng.standard_normal(mean.shape, np.float32)
    return np.clip(np.rint(electrons / ELECTRONS + BLACK_DN), 0, 255).astype(np.uint8)


def shown(camera, place, target):
    """The ellipses of the three outer rims."""
    return Ellipses(*ellipses_of(camera, place, circle_layout.circle_centres(target), target.outer_diameter_mm / 2))


def facing(rng, tilt_deg=35.0):
    """A pose whose front faces the cameras, tilted to all sides, turned anyhow, over the working volume."""
    turn = Rotation.from_euler("zyx", [rng.uniform(-180, 180), *rng.uniform(-tilt_deg, tilt_deg, 2)], degrees=True).as_matrix()
    middle = rng.uniform([-50, -45, 610], [50, 45, 705])
    turn = np.diag([1.0, -1.0, -1.0]) @ turn
    return rigid.transform(turn, middle - turn @ [10.0, 15.0, 0.0])


def exposure(world_from_target, shift_mm, steps=15):
    """Poses over an exposure, during which the target moves evenly by a shift : (3,) mm in the world, about the given one."""
    moved = []
    for t in (np.arange(steps) + 0.5) / steps - 0.5:
        place = np.array(world_from_target)
        place[:3, 3] += t * np.asarray(shift_mm)
        moved.append(place)
    return moved


def _on_board(camera, world_from_target, rays):
    """Where rays : (..., 3) meet the board's plane : two of (...) mm in the target's frame."""
    local = rigid.rotate(rigid.invert(world_from_target), rays)
    start = rigid.apply(rigid.invert(world_from_target), camera.centre)
    along = -start[2] / local[..., 2]
    return start[0] + along * local[..., 0], start[1] + along * local[..., 1]
