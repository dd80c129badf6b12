"""A probe over N-wires: where a perfect tracker and scanner would see their dots, noise of a known size, and drawn B-scans."""

import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.model.wire_phantom import FCAL_2, WirePhantom
from recon.probe_calibration.line_calibration import DotSightings
from tests.recon import bscans

FCAL = WirePhantom(np.array(FCAL_2, float))
WORLD_FROM_PHANTOM = rigid.from_rotation_vector([0.4, -0.3, 2.0], [30.0, -20.0, 700.0])
ANGLE_DEG, POSITION_MM, PIXEL_PX = 0.08, 0.05, 0.5  # standard deviations per axis


def poses_over(probe, phantom, size, rng, count=30, turn_deg=20.0):
    """Poses (n, 4, 4) world_from_target, turned to all sides, the middle of the wires near that of the image."""
    middle = phantom.ends.mean(axis=(0, 1, 2))
    upright = np.column_stack([phantom.across[0], -phantom.across[1], phantom.along])  # x along rows, y down, z along wires
    upright[:, 2] *= np.linalg.det(upright)
    result = []
    for _ in range(count):
        turned = upright @ Rotation.from_euler("YXZ", rng.uniform(-1, 1, 3) * [turn_deg, turn_deg, 8.0], degrees=True).as_matrix()
        place = middle + rng.uniform(-10, 10) * phantom.along
        centre = np.append((np.array(size) - 1) / 2 * probe.scale + rng.uniform(-2, 2, 2), 0.0)
        phantom_from_image = rigid.transform(turned, place - turned @ centre)
        result.append(WORLD_FROM_PHANTOM @ phantom_from_image @ rigid.invert(probe.target_from_image))
    return np.array(result)


def dots_of(probe, phantom, poses, beside=0.0):
    """Pixels (n, k, 2) where the wires, (k, 3) mm beside their places, meet the image's plane: by line and plane in space."""
    pixels = []
    for pose in poses:
        image_from_phantom = rigid.invert(probe.target_from_image) @ rigid.invert(pose) @ WORLD_FROM_PHANTOM
        points = rigid.apply(image_from_phantom, phantom.points + beside)
        along = rigid.rotate(image_from_phantom, phantom.directions)
        pixels.append((points - (points[:, 2:] / along[:, 2:]) * along)[:, :2] / probe.scale)
    return np.array(pixels)


def observe(probe, phantom, poses, rng, beside=0.0, noise=1.0):
    """Sightings with the tracker's and the scanner's noise."""
    pixels = dots_of(probe, phantom, poses, beside)
    seen = poses.copy()
    for pose in seen:
        pose[:3, :3] = Rotation.from_rotvec(noise * np.radians(ANGLE_DEG) * rng.standard_normal(3)).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += noise * POSITION_MM * rng.standard_normal(3)
    return sightings_of(seen, pixels + noise * PIXEL_PX * rng.standard_normal(pixels.shape))


def sightings_of(poses, pixels):
    """Dots of known wires, each to PIXEL_PX."""
    covariance = np.broadcast_to(PIXEL_PX**2 * np.eye(2), (*pixels.shape, 2))
    return DotSightings(poses, pixels[:, None], covariance[:, None])


def drawn(pixels, rng, more=()):
    """A B-scan with a dot at each of some pixels, as bright as wires are, and echoes of other amplitudes besides."""
    echoes = sum((bscans.spot(pixel, peak_db=rng.uniform(-12, -3)) for pixel in pixels), sum(more, np.zeros((1, 1))))
    return bscans.image(echoes, rng)
