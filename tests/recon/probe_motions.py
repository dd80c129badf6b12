"""A probe that looks at one point from all sides: what a perfect tracker and scanner would report, and noise of a known size."""

import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.probe_calibration import point_calibration
from recon.probe_calibration.point_calibration import Sightings

WIRE = np.array([5.0, -10.0, 800.0])  # mm, in the world
LOOKING_AWAY = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # world_from_image of a probe that looks along the world's z
FOREIGN_SIZES = ((640, 480), (800, 600), (1024, 768), (480, 640), (400, 500))  # px
ANGLE_DEG, POSITION_MM, PIXEL_PX, SLICE_MM = 0.08, 0.05, 0.15, 0.1  # standard deviations per axis


def true_probe(rig):
    """The rig's probe, without uncertainty."""
    return ProbeCalibration(rig.probe.target_from_image.matrix(), np.array(rig.probe.scale_mm_per_px))


def foreign_probe(rng):
    """A probe of another rig: the size of its B-scans, and its calibration, on a bracket to any side."""
    size = FOREIGN_SIZES[rng.integers(len(FOREIGN_SIZES))]
    scale = rng.uniform(30, 160) / size[1] * np.array([rng.uniform(0.7, 1.3), 1.0])
    side = rng.standard_normal(3)
    pose = rigid.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(40, 200) * side / np.linalg.norm(side))
    return size, ProbeCalibration(pose, scale)


def motion(rig, roll_deg=180.0):
    """Turns and pixels of 30 frames, as recommended, with the roll as far as the tracking allows."""
    return point_calibration.motion(rig.probe.image_size, roll_deg=roll_deg)


def poses_of(probe, turns, pixels):
    """Poses (n, 4, 4) world_from_target at which the wire is at the pixels."""
    result = []
    for (tilt, roll, rock), pixel in zip(turns, pixels, strict=True):
        world_from_image = LOOKING_AWAY @ Rotation.from_euler("YXZ", [roll, tilt, rock], degrees=True).as_matrix()
        turn = world_from_image @ probe.target_from_image[:3, :3].T
        result.append(rigid.transform(turn, WIRE - turn @ probe.to_target(pixel)))
    return np.array(result)


def observe(probe, turns, pixels, rng):
    """The same with the tracker's and the scanner's noise, and the wire somewhat beside the image plane."""
    poses = poses_of(probe, turns, pixels)
    for pose in poses:
        pose[:3, 3] -= pose[:3, :3] @ probe.target_from_image[:3, 2] * SLICE_MM * rng.standard_normal()
        pose[:3, :3] = Rotation.from_rotvec(np.radians(ANGLE_DEG) * rng.standard_normal(3)).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += POSITION_MM * rng.standard_normal(3)
    return Sightings(poses, pixels + PIXEL_PX * rng.standard_normal(pixels.shape))


def with_outliers(sightings, share, rng):
    """The same with some crossings elsewhere in the image."""
    pixels = sightings.pixels.copy()
    wrong = rng.choice(len(pixels), round(share * len(pixels)), replace=False)
    pixels[wrong] = rng.uniform([10, 10], [310, 400], (len(wrong), 2))
    return Sightings(sightings.poses, pixels), wrong
