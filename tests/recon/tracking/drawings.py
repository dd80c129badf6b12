"""Frames of the target, drawn: rings by supersampling on the pixel grid, blurred by lens and motion, read by the rig's sensor."""

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of
from recon.geometry.ellipses import Ellipses
from recon.model import circle_layout
from tests.recon import plane_views

ELECTRONS = 7700 / 255  # a digital number
DARK_E = 11.0
BLACK_DN = 2.0
LENS_PX = 0.55  # standard deviation in focus, of the lens with a little defocus
SUBSAMPLES = 5  # a side
BLURRED_PX = 6  # about the board: ten times the lens's blur
STRIP = 64  # rows
ROOM_MM = 86.0  # between the middles of two boards, of a half diagonal of 43 mm
MARGIN_MM = 14.0  # of white about the discs' middles
BOARD = np.array([[-MARGIN_MM, -MARGIN_MM], [25 + MARGIN_MM, 40 + MARGIN_MM]])  # mm, corners in the target's frame


def _part(camera: Camera, poses):
    """The rows and columns of the image that may show the board at any of the poses, with what blurs into them; may be empty."""
    width, height = camera.size
    corners = np.array([[x, y, 0.0] for x in BOARD[:, 0] for y in BOARD[:, 1]])
    seen = np.concatenate([camera.project(rigid.apply(place, corners)) for place in poses])
    left, top = np.clip(np.floor(seen.min(axis=0)).astype(int) - BLURRED_PX, 0, [width, height])
    right, bottom = np.clip(np.ceil(seen.max(axis=0)).astype(int) + BLURRED_PX + 1, 0, [width, height])
    return np.s_[top:bottom, left:right]


def reflectance(camera: Camera, poses, target, part, ground=0.25, black=0.04):
    """Mean over poses, of what a camera sees in a part of its image, white board 1, blurred by pixels and motion alone."""
    count = SUBSAMPLES if len(poses) == 1 else 2
    rows, columns = (np.arange(axis.start, axis.stop, dtype=float) for axis in part)
    seen = (np.moveaxis(plane_views.places(camera, place, rows, columns), -1, 0) for place in poses)
    return np.mean([_board(x, y, target, ground, black, count) for x, y in seen], axis=0)


def _board(x, y, target, ground, black, count):
    """Brightness : (h, w) at places x, y : (h, w) mm, by sub-pixels where an edge is near; elsewhere a pixel looks alike."""
    slopes = np.array([np.gradient(axis) for axis in (x, y)])  # of x and y, by v and u
    scale = np.hypot(slopes[0, 1], slopes[0, 0]) / count
    reach = np.hypot(*slopes).sum(axis=0) / 2 + scale  # mm, from a pixel's middle to what counts for its corners
    part = (np.arange(count) + 0.5) / count - 0.5
    middle, half = BOARD.mean(axis=0), (BOARD[1] - BOARD[0]) / 2

    def sampled(brightness, near):
        """Mean of a brightness over the sub-pixels of some pixels."""
        px, py, *by = (axis[near] for axis in (x, y, *slopes[0], *slopes[1]))
        width = scale[near]
        return (
            sum(brightness(px + dv * by[0] + du * by[1], py + dv * by[2] + du * by[3], width) for dv in part for du in part)
            / count**2
        )

    def board(px, py, scale):
        across = np.clip((half[0] - np.abs(px - middle[0])) / scale + 0.5, 0, 1)
        return ground + (1 - ground) * across * np.clip((half[1] - np.abs(py - middle[1])) / scale + 0.5, 0, 1)

    total = board(x, y, scale)
    near = np.minimum(np.abs(np.abs(x - middle[0]) - half[0]), np.abs(np.abs(y - middle[1]) - half[1])) < reach
    total[near] = sampled(board, near)
    outer, inner = target.outer_diameter_mm / 2, target.inner_diameter_mm / 2
    for cx, cy, _ in circle_layout.circle_centres(target):  # none lies near another, nor near the board's edge

        def disc(px, py, scale, cx=cx, cy=cy):
            away = np.hypot(px - cx, py - cy)
            return 1 - (1 - black) * np.clip((outer - away) / scale + 0.5, 0, 1) * np.clip((away - inner) / scale + 0.5, 0, 1)

        about = np.nonzero((np.abs(x - cx) < outer + 1) & (np.abs(y - cy) < outer + 1))
        away = np.hypot(x[about] - cx, y[about] - cy)
        total[about] = np.where((away > inner) & (away < outer), black, total[about])
        edge = np.minimum(np.abs(away - outer), np.abs(away - inner)) < reach[about]
        near = tuple(index[edge] for index in about)
        total[near] = sampled(disc, near)
    return total


def frame(camera, poses, target, white=100.0, rng=None, lens=LENS_PX, ground=0.25, light=None):
    """An 8-bit frame : (h, w) of poses : a list, over the exposure; noise if there is a generator, else float DN.

    What shows no board has noise that repeats itself every `STRIP` rows, unless it is lit unevenly.
    """
    width, height = camera.size
    part = _part(camera, poses)
    even = rng is not None and light is None
    image = np.full((STRIP if even else height, width), white * ground)
    if even:
        image = np.tile(read_out(image, rng), (-(-height // STRIP), 1))[:height]
    if image[part].size:
        sharp = reflectance(camera, poses, target, part, ground)
        seen = white * gaussian_filter(sharp, lens, mode="nearest")
        image[part] = read_out(seen, rng) if even else seen
    if light is not None:
        image = image * light
    return image if even else image + BLACK_DN if rng is None else read_out(image, rng)


def together(camera, bodies, white=65.0, rng=None):
    """A frame of several bodies : pairs of poses over the exposure, a list, and a target; later ones lie before earlier ones."""
    image = None
    for poses, target in bodies:
        one = frame(camera, poses, target, white, rng)
        if image is not None:
            corners = np.array([[x, y, 0.0] for x, y in zip(BOARD[[0, 1, 1, 0], 0], BOARD[[0, 0, 1, 1], 1], strict=True)])
            there = np.zeros(one.shape, np.uint8)
            for place in poses:
                outline = np.rint(camera.project(rigid.apply(place, corners))).astype(np.int32)
                cv2.fillConvexPoly(there, outline, 1)
            one = np.where(cv2.dilate(there, np.ones((5, 5))) > 0, one, image)
        image = one
    return image


def apart(rng, targets, tilt_deg=30.0):
    """Poses of bodies that face the cameras, with room between their boards, in both views."""
    while True:
        middles = rng.uniform([-90, -65, 620], [80, 65, 700], (len(targets), 3))
        away = np.linalg.norm(middles[:, None, :2] - middles[None, :, :2], axis=-1) + 1e9 * np.eye(len(targets))
        if away.min() > ROOM_MM:
            break
    turns = Rotation.from_euler(
        "zyx", rng.uniform([-180, -tilt_deg, -tilt_deg], [180, tilt_deg, tilt_deg], (len(targets), 3)), True
    )
    turns = np.diag([1.0, -1.0, -1.0]) @ turns.as_matrix()
    return [rigid.transform(turn, middle - turn @ [12.5, 20.0, 0.0]) for turn, middle in zip(turns, middles, strict=True)]


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
