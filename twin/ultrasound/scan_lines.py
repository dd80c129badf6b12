"""Lines of a B-scan in the image's plane: parallel ones, or the fan of a curved array.

The scanner's own coordinates are `along`, mm on the face from the first line, and `depth`, mm on a line. The face's frame has x
along the array, y into the depth, and its origin on the first line, or in the middle of a curved array. There a place at an
angle a from the middle line is

    x = (R + depth) sin a,   y = (R + depth) cos a - R,   along = middle + R a,

and lines are `1 + depth / R` times as far apart as on the face.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from recon.compiled import njit
from recon.geometry import rigid
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]


class Lines(NamedTuple):
    """Lines of a transducer, for compiled code."""

    count: int
    pitch_mm: float  # on the face
    bend: float  # 1/mm, of the face: 0 of a linear array, 1/R of a curved one

    @property
    def middle_mm(self) -> float:
        """Place on the face, along it, of its middle."""
        return self.pitch_mm * (self.count - 1) / 2


def lines_of(transducer: Transducer) -> Lines:
    """The lines of a transducer."""
    face = transducer.face
    if face is None:
        return Lines(transducer.image_size[0], transducer.scale_mm_per_px[0], 0.0)
    return Lines(face.lines, face.pitch_mm, face.bend)


def world_from_face(transducer: Transducer, world_from_image: Array) -> Array:
    """Pose of the face's frame : (..., 4, 4)."""
    if transducer.face is None:
        return world_from_image
    return world_from_image @ rigid.transform(np.eye(3), (*transducer.face_mm, 0.0))


def middle_of_face(transducer: Transducer) -> Array:
    """Frame of the middle of the face in that of the face : (4, 4)."""
    aside = transducer.face_mm[0] if transducer.face is None else 0.0
    return rigid.transform(np.eye(3), [aside, 0.0, 0.0])


def world_from_lines(lines: Lines, world_from_face: Array, along: Array) -> Array:
    """Poses (n, 4, 4) of lines at places : (n,) mm on the face: x along the face, y down the line, z across the plane."""
    poses = np.tile(np.eye(4), (len(along), 1, 1))
    if lines.bend == 0:
        poses[:, 0, 3] = along
    else:
        angle = (along - lines.middle_mm) * lines.bend
        poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
        poses[:, 0, 1], poses[:, 1, 0] = np.sin(angle), -np.sin(angle)
        poses[:, 0, 3], poses[:, 1, 3] = np.sin(angle) / lines.bend, (np.cos(angle) - 1) / lines.bend
    return np.ascontiguousarray(world_from_face @ poses)


@njit(inline="always")
def on_lines(x, y, bend, middle_mm):
    """Along and depth of a place in the face's frame."""
    if bend == 0:
        return x, y
    radius = 1 / bend
    return middle_mm + radius * np.arctan2(x, y + radius), np.sqrt(x * x + (y + radius) ** 2) - radius


@njit(inline="always")
def widening(depth, bend):
    """Distance of lines at a depth, over that on the face."""
    return 1 + depth * bend


def converted(shown: NDArray, transducer: Transducer, order: int) -> NDArray:
    """The image (h, w) of values on lines : (rows, lines), 0 beside the fan; a linear array's is as it stands.

    order : 0 for the nearest value, 1 for linear interpolation
    """
    if transducer.face is None:
        return shown
    lines, (sx, sy) = lines_of(transducer), transducer.scale_mm_per_px
    width, height = transducer.image_size
    x, y = sx * np.arange(width) - transducer.face_mm[0], (sy * np.arange(height) - transducer.face_mm[1])[:, None]
    along, depth = on_lines.py_func(x, y, lines.bend, lines.middle_mm)
    return map_coordinates(shown, [depth / sy, along / lines.pitch_mm], order=order, mode="constant", cval=0)
