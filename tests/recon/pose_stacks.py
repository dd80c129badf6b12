"""Poses of B-scans whose maps have closed forms: parallel, crossing, and unsteady ones."""

import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.segmentation import insonation

MM, SHAPE = 0.25, (160, 160)  # 40 x 40 mm
SCALE = np.diag([MM, MM, 1, 1])


def stack(places_mm):
    """Parallel B-scans across z, their beams along y."""
    return np.stack([rigid.transform(np.eye(3), [0, 0, z]) @ SCALE for z in places_mm])


def crossing(places_mm):
    """The same with B-scans whose array lies along z, over the same place."""
    turn = Rotation.from_rotvec([0, -np.pi / 2, 0]).as_matrix()
    return np.stack([rigid.transform(turn, [x + 20, 0, -20]) @ SCALE for x in places_mm])


def sweep(rng, count=30):
    """An unsteady sweep."""
    turns = Rotation.from_rotvec(np.deg2rad(rng.normal(0, 3, (count, 3)))).as_matrix()
    places = np.column_stack([rng.normal(0, 0.3, (count, 2)), np.linspace(-15, 15, count)])
    return np.stack([rigid.transform(turn, place) @ SCALE for turn, place in zip(turns, places, strict=True)])


def voxel(where, place):
    """Index (k, j, i) of the voxel at a place, mm."""
    index = rigid.apply(np.linalg.inv(insonation.world_from_voxel(where.grid)), np.array(place, float))
    return tuple(np.rint(index).astype(int)[::-1].tolist())
