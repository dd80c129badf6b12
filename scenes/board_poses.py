"""Random poses of a calibration board that fill the views of the cameras and the projector.

Tilt, turn, depth and place of pose k are point k of a scrambled Sobol' sequence: any number of poses covers all of them evenly,
and pose k depends on the seed and on k alone.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.rig import NotNegative, Part, Positive
from scenes.noise import Seed

Array = rigid.Array

TRIES = 200  # of orientations for one pose
GRID = 24  # places across and down the view where room is looked for
STEPS = 12  # of the bisection to the border of the room: a 2000th of the way
DEPTHS_MM = (606.0, 713.0)  # the working range of the rig of Meza et al. 2021


class Config(Part):
    """Number of poses, and their limits."""

    count: Annotated[int, Field(ge=1, le=1000)] = 34
    tilt_deg: Annotated[float, Field(ge=0, le=70)] = 40.0  # largest angle between the board's normal and camera 1's axis
    depth_mm: tuple[Positive, Positive] | None = None  # nearest and farthest z of the board's middle; DEPTHS_MM if not given
    margin_px: NotNegative = 10.0  # that every circle keeps from the border, in both cameras and the projector
    seed: Seed = 1

    @field_validator("depth_mm")
    @classmethod
    def _near_to_far(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and value[0] > value[1]:
            raise ValueError(f"expected the nearer depth first, found {value[0]:g}, {value[1]:g}")
        return value

    @property
    def depths_mm(self) -> tuple[float, float]:
        """The nearest and the farthest."""
        return self.depth_mm or DEPTHS_MM


def random_poses(config: Config, design: AsymmetricCircles, devices: Sequence[Camera]) -> Array:
    """Poses `world_from_board` : (count, 4, 4) in which every device has every circle's whole rim in its image.

    devices : the first is camera 1, whose view is searched for room.

    Raises
    ------
    InputError
        If the board has no room in all images at a depth.
    """
    draws = qmc.Sobol(6, seed=np.random.default_rng(config.seed)).random_base2((config.count - 1).bit_length())
    return np.stack([_pose(config, k, draws[k], design, devices) for k in range(config.count)])


def _orientation(tilt_deg: float, draw: Array) -> Array:
    """Rotation : (3, 3) of a board from three numbers in [0, 1]: its turn in the plane, then how far and which way it tilts.

    Turns are drawn towards the quarters, for only a board that stands straight fills the corners of an image. Normals spread
    evenly over the cap of directions up to `tilt_deg` away, so that large tilts, which tell most, are common.
    """
    quarter, beside = np.divmod(4 * draw[0], 1)
    askew = 2.0  # power that draws turns to the quarters: half of them lie within 11 deg
    turn = np.pi / 2 * (quarter + 0.5 * _draw(2 * beside - 1, askew))
    tilt, way = np.deg2rad(tilt_deg) * np.sqrt(draw[1]), 2 * np.pi * draw[2]
    tilted = Rotation.from_rotvec(tilt * np.array([np.cos(way), np.sin(way), 0]))
    return (tilted * Rotation.from_rotvec([0, 0, turn])).as_matrix()


def outline(design: AsymmetricCircles) -> Array:
    """A convex outline around all circles : (n, 3) mm in the board's frame."""
    rim_points = 16  # corners of the polygon around each circle
    turn = 2 * np.pi * np.arange(rim_points) / rim_points
    circle = design.diameter_mm / 2 * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(rim_points)])
    rims = (design.points()[:, None] + circle / np.cos(np.pi / rim_points)).reshape(-1, 3)
    return rims[ConvexHull(rims[:, :2]).vertices]


def _pose(config: Config, k: int, draw: Array, design: AsymmetricCircles, devices: Sequence[Camera]) -> Array:
    """Pose k. Where its orientation finds no room, as a board held upright close to the cameras, others are tried."""
    rng = np.random.default_rng([config.seed, k])
    near, far = config.depths_mm
    depth = near + draw[0] * (far - near)
    points = design.points()
    middle, hull, angles = (points.min(axis=0) + points.max(axis=0)) / 2, outline(design), draw[1:4]
    for _ in range(TRIES):
        rotation = _orientation(config.tilt_deg, angles)
        place = _place((hull - middle) @ rotation.T, depth, draw[4:], config.margin_px, devices)
        if place is not None:
            return rigid.transform(rotation, place - rotation @ middle)
        angles = rng.uniform(size=3)
    raise InputError(f"poses.depth_mm: expected room for the board in all views, found none at {depth:.0f} mm")


def _place(hull: Array, depth: float, draw: Array, margin: float, devices: Sequence[Camera]) -> Array | None:
    """Where the board's middle goes : (3,) mm, at a depth, from two numbers in [0, 1]; None if it has no room.

    The numbers name a point of a square that is laid over the room around the room's middle, and drawn outwards.
    """
    corners = devices[0].rays((np.array([[0, 0], [1, 1]])) * (np.array(devices[0].size) - 1.0))
    (left, top), (right, bottom) = corners[:, :2] / corners[:, 2:] * depth
    x, y = np.meshgrid(np.linspace(left, right, GRID), np.linspace(top, bottom, GRID))
    places = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth)])
    room = places[_all_see(places, hull, margin, devices)]
    if len(room) == 0:
        return None
    middle = room[np.linalg.norm(room - room.mean(axis=0), axis=1).argmin()]
    outwards = 0.3  # power that draws poses from the middle to the corners of the room
    square = _draw(2 * draw - 1, outwards)
    away = max(np.abs(square).max(), 1e-9)
    border = np.append(np.abs(room - middle)[:, :2].max(axis=0) * square / away, 0)
    near, far = 0.0, 2.0
    for _ in range(STEPS):
        half = (near + far) / 2
        near, far = (half, far) if _all_see((middle + half * border)[None], hull, margin, devices)[0] else (near, half)
    return middle + near * away * border


def _draw(values: Array, power: float) -> Array:
    """Values from -1 to 1 drawn to zero (power above 1) or away from it (below)."""
    return np.sign(values) * np.abs(values) ** power


def _all_see(places: Array, hull: Array, margin: float, devices: Sequence[Camera]) -> NDArray[np.bool_]:
    """Whether every device has the whole hull in its image, for each place of its middle : (n, 3), as (n,)."""
    seen = np.ones(len(places), bool)
    for device in devices:
        pixels = device.project(places[:, None] + hull)
        low, high = margin, np.array(device.size) - 1 - margin
        seen &= ((pixels >= low) & (pixels <= high)).all(axis=(1, 2))
    return seen
