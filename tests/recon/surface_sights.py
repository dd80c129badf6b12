"""A probe over a wall or a sphere at rest: what a perfect tracker and scanner would report, and noise of a known size."""

import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.probe_calibration.surface_calibration import CurveSightings, Sphere, Wall
from tests.recon.probe_motions import LOOKING_AWAY

SIZE = (321, 408)
WALL = Wall(Rotation.from_euler("xy", [4, -3], degrees=True).apply([0, 0, -1.0]), np.array([5.0, -10.0, 800.0]))
RADIUS = (19.8, 0.05)  # mm, and its standard deviation
BALL = Sphere(np.array([5.0, -10.0, 800.0]), RADIUS[0], RADIUS)
ANGLE_DEG, POSITION_MM, ROW_PX = 0.05, 0.05, 0.2  # standard deviations per axis; of a node's row


def poses_over(probe, surface, rng, count=100, tilt=40.0, rock=25.0, roll=90.0, depth=(13.0, 38.0), aside=8.0, miss=8.0):
    """Poses : (n, 4, 4) world_from_target of a probe that looks at the surface, tilted to all sides."""
    turns = rng.uniform(-1, 1, (count, 3)) * [roll, tilt, rock]
    world_from_image = LOOKING_AWAY @ Rotation.from_euler("YXZ", turns, degrees=True).as_matrix()
    radius = surface.radius if isinstance(surface, Sphere) else 0.0
    middle = surface.centre if isinstance(surface, Sphere) else surface.middle
    half, flat = (SIZE[0] - 1) / 2 * probe.scale[0], radius == 0
    places = np.column_stack([
        half + (not flat) * rng.uniform(-aside, aside, count),
        rng.uniform(*depth, count) + radius,
        (not flat) * rng.uniform(-miss, miss, count),
    ])  # fmt: skip
    aims = middle + flat * (rng.uniform(-aside, aside, (count, 2)) @ surface.across if flat else 0)
    image_from_target = rigid.invert(probe.target_from_image)
    return np.stack([
        rigid.transform(turn, aim - turn @ place) @ image_from_target
        for turn, aim, place in zip(world_from_image, aims * np.ones((count, 1)), places, strict=True)
    ])  # fmt: skip


def curves_of(probe, surface, poses, mirror=0.0, nearer_mm=0.0):
    """Points : (n, k, 2) px of the curves: of a wall at Gauss's places of the whole width, of a sphere of its near side."""
    count = 3 if isinstance(surface, Sphere) else 2
    shares = np.array([-1, 0, 1]) * np.sqrt(0.6) if count == 3 else np.array([-1, 1]) / np.sqrt(3)
    result = np.zeros((len(poses), count, 2))
    for k, pose in enumerate(poses):
        world_from_image = pose @ probe.target_from_image
        middle, half = (SIZE[0] - 1) / 2, (SIZE[0] - 1) / 2
        if count == 3:
            centre = rigid.apply(rigid.invert(world_from_image), surface.centre)
            middle, half = centre[0] / probe.scale[0], (0.4 * surface.radius) / probe.scale[0]
        for node, u in enumerate(middle + half * shares):
            start, down = rigid.apply(world_from_image, [u * probe.scale[0], 0, 0]), world_from_image[:3, 1]
            if count == 2:
                y = -surface.distances(start) / (down @ surface.normal)
            else:
                arm = start - surface.centre
                b = arm @ down
                y = -b - np.sqrt(b**2 - arm @ arm + surface.radius**2)
            normal = surface.normals(start + y * down)
            sine = normal @ world_from_image[:3, 2]
            y -= nearer_mm * (sine / (normal @ down)) ** 2
            y -= mirror * y * (1 - np.sqrt(1 - sine**2)) / (1 + surface.curvature * y)
            result[k, node] = u, y / probe.scale[1]
    return result


def observe(probe, surface, rng, mirror=0.0, nearer_mm=0.0, **motion):
    """The same with the tracker's and the scanner's noise."""
    poses = poses_over(probe, surface, rng, **motion)
    pixels = curves_of(probe, surface, poses, mirror, nearer_mm)
    return noisy(poses, pixels, rng)


def noisy(poses, pixels, rng):
    """Poses and points with noise, and its covariance of the rows."""
    poses, pixels = poses.copy(), pixels.copy()
    for pose in poses:
        pose[:3, :3] = Rotation.from_rotvec(np.radians(ANGLE_DEG) * rng.standard_normal(3)).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += POSITION_MM * rng.standard_normal(3)
    pixels[..., 1] += ROW_PX * rng.standard_normal(pixels.shape[:2])
    n, k = pixels.shape[:2]
    return CurveSightings(poses, pixels, np.broadcast_to(ROW_PX**2 * np.eye(k), (n, k, k)).copy())
