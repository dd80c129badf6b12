"""Offset between the projected centre of a circle and the centre of its ellipse, for a given camera and pose.

Perspective shows the near half of a tilted disc larger than the far half, so the ellipse's centre lies on the near side of the
projected centre, by about `f r^2 sin(w) cos(w) / Z^2` for a tilt of w; the lens bends the outline on top of that. A detector
measures the ellipse, a calibration needs the centre: subtract the offset, and repeat as camera and pose get better.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.ellipses import fit_ellipses, from_outline

Array = NDArray[np.float64]

OUTLINE = 48  # points a circle; the ellipse needs five, the rest averages what the lens does


def centre_offsets(camera: Camera, world_from_board: Array, points: ArrayLike, radius_mm: float) -> Array:
    """What a detector of ellipses measures less where the centres are.

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
    centres = np.asarray(points, float)
    angles = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
    rim = radius_mm * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(OUTLINE)])
    outlines = camera.project(rigid.apply(world_from_board, centres[:, None] + rim))
    offsets = np.full((len(centres), 2), np.nan)
    seen = np.isfinite(outlines).all(axis=(1, 2))
    if seen.any():
        fit = fit_ellipses(outlines[seen], np.ones((seen.sum(), OUTLINE)), from_outline(outlines[seen]))
        offsets[seen] = fit.ellipses.centre - camera.project(rigid.apply(world_from_board, centres[seen]))
    return offsets
