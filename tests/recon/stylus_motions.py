"""A probe that sees the tip of a tracked stylus, both in motion: poses of both by a noisy tracker, and pixels of the tip."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.model.tip import Tip
from recon.model.tracks import Track
from recon.probe_calibration import point_calibration

TIP = np.array([2.0, -4.0, -150.0])  # mm, in the frame of the stylus' target
POSE_MM, POSE_DEG, SLICE_MM, TIP_MM = 0.05, 0.05, 0.2, 0.05  # standard deviations in each axis
PIXEL_PX = np.array([1.0, 0.5])


@dataclass
class Led:
    """Both bodies in n frames, as they are."""

    probe: np.ndarray  # (n, 4, 4) world_from_target
    stylus: np.ndarray
    pixels: np.ndarray  # (n, 2) where the tip's echo is


def lead(calibration, size, rng, count=40, turned=1.0, slice_mm=SLICE_MM) -> Led:
    """The tip comes near all corners of the image, the probe turned about it by a share of what is usual."""
    turns, pixels = point_calibration.motion(size, count)
    across = calibration.target_from_image[:3, 2]
    probe, stylus = [], []
    for (tilt, roll, rock), pixel in zip(turned * turns, pixels, strict=True):
        image = Rotation.from_euler("YXZ", [roll, tilt, rock], degrees=True)
        turn = (Rotation.from_euler("x", 70, degrees=True) * image).as_matrix() @ calibration.target_from_image[:3, :3].T
        place = calibration.to_target(pixel) + slice_mm * rng.standard_normal() * across
        held = rigid.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform([-50, -50, 650], [50, 50, 750]))
        probe.append(held @ rigid.transform(turn, TIP - turn @ place))
        stylus.append(held)
    return Led(np.array(probe), np.array(stylus), pixels + PIXEL_PX * rng.standard_normal((count, 2)))


def tracked(poses, rng, times=None, known=True) -> Track:
    """Poses with the tracker's noise, and its covariance, if that is known."""
    sigma = np.repeat([np.radians(POSE_DEG), POSE_MM], 3)
    noisy = np.array([rigid.moved(pose, sigma * rng.standard_normal(6)) for pose in poses])
    moments = np.arange(len(poses)) * 10**8 if times is None else times
    return Track(moments, noisy, np.tile(np.diag(sigma**2), (len(poses), 1, 1)) if known else None)


def known_tip(rng) -> Tip:
    """The tip by a calibration with an error."""
    return Tip(TIP + TIP_MM * rng.standard_normal(3), TIP_MM**2 * np.eye(3), body="stylus")
