"""The line on the skin along which the B-scan's plane meets it, to be seen on both sides of the probe."""

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.skin_projection import skin_curve
from recon.skin_projection.lines_of_sight import Sight
from recon.skin_projection.skin_curve import SkinCurve

Array = NDArray[np.float64]

BEYOND_MM = 20.0  # either end of the array, whose own part of the line lies under the probe


def on_skin(name: str, world_from_pixel: Array, width: int, skin: trimesh.Trimesh) -> SkinCurve:
    """The line of a B-scan `width` px wide, and some way beyond.

    Each depth line of the scan, or its continuation, meets the skin in one point of the curve: so it is right for a probe that is
    held over the skin as well as for one that presses it in.

    Parameters
    ----------
    world_from_pixel : (4, 4)
        From (u, v, 0, 1) in px to mm, as `Scans.world_from_pixel` has them.
    """
    beyond = BEYOND_MM / np.linalg.norm(world_from_pixel[:3, 0])
    ends = rigid.apply(world_from_pixel, np.array([[-beyond, 0, 0], [width - 1 + beyond, 0, 0]]))
    face = skin_curve.evenly(ends)
    sight = Sight.along(world_from_pixel[:3, 1], face.mean(axis=0))
    return skin_curve.laid(name, "scan", sight.chart(face)[:, :2], sight, skin)
