"""Offset between the projected centre of a circle and the centre of its ellipse, for a given camera and pose.

Perspective shows the near half of a tilted disc larger than the far half, so the ellipse's centre lies on the near side of the
projected centre, by about `f r^2 sin(w) cos(w) / Z^2` for a tilt of w; the lens bends the outline on top of that. A detector
measures the ellipse, a calibration needs the centre: subtract the offset, and repeat as camera and pose get better.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of

Array = NDArray[np.float64]


def centre_offsets(camera: Camera, world_from_board: Array, points: ArrayLike, radius_mm: float) -> Array:
    """Offset of a detected ellipse's middle from the projected centre.

    Parameters
    ----------
    camera : Camera
        With its distortion.
    world_from_board : (4, 4) mm
        The board's pose.
    points : (n, 3) mm
        Centres of circles in the board's frame; the circles lie parallel to its plane z = 0.
    radius_mm : float
        Of the circles.

    Returns
    -------
    (n, 2) px
        Centre of the ellipse fitted to the projected outline, minus the projection of the centre; NaN behind the camera.
    """
    centres = np.ascontiguousarray(points, float)
    return ellipses_of(camera, world_from_board, centres, radius_mm)[0] - camera.project(rigid.apply(world_from_board, centres))
