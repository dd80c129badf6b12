"""Bodies, poses and measures that tests of the B-mode model share."""

from dataclasses import replace

import numpy as np

from recon.geometry import rigid
from scenes.acoustics import TISSUES
from scenes.tissue import Tissue
from twin.ultrasound.echo_solids import Body, Wire
from twin.ultrasound.transducer import Transducer


def filament(depth: float, beside: float = 0.0, length: float = 40.0, middle: float = 0.0) -> Body:
    """A smooth wire along y at z = depth, in a medium of 1540 m/s without loss or echoes."""
    ends = np.array([[beside, middle - length / 2, depth], [beside, middle + length / 2, depth]])
    return Body(Tissue(1.5, 1540.0, 0.0, None), (), (Wire("wire", replace(TISSUES["steel"], roughness=0.0), ends, 0.01),))


def down(transducer: Transducer, face: tuple[float, float, float], tilt_deg: float = 0.0) -> np.ndarray:
    """A pose that looks along the world's z, the array along x, its middle at `face`; tilted in the image plane."""
    upright = rigid.transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], face)
    tilt = rigid.from_rotation_vector([0, 0, np.deg2rad(tilt_deg)], [0, 0, 0])
    return upright @ tilt @ rigid.transform(np.eye(3), (-transducer.face_mm[0], -transducer.face_mm[1], 0))


def width_at_half(profile: np.ndarray, step: float) -> float:
    """Full width at half maximum of a profile with one peak."""
    peak = int(profile.argmax())
    half = profile[peak] / 2
    left = np.flatnonzero(profile[:peak] < half)[-1]
    right = peak + np.flatnonzero(profile[peak:] < half)[0]
    start = left + (half - profile[left]) / (profile[left + 1] - profile[left])
    end = right - (half - profile[right]) / (profile[right - 1] - profile[right])
    return step * (end - start)


def peak(profile: np.ndarray) -> float:
    """Place of the highest sample, by a parabola through it and its neighbours."""
    top = int(profile.argmax())
    before, here, after = (float(value) for value in profile[top - 1 : top + 2])
    return top + (before - after) / (2 * (before - 2 * here + after))
