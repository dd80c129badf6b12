"""The scale of a calibration, from a length on the board that was measured by itself.

Images give no scale: lengths are those of the board's design, as far as it is printed so. One length measured on the board, by a
caliper or a microscope, tells how much larger it is. Both together, the length and what is usual of prints, weighed by their
variances, are the scale; all translations, and the board, grow by it.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry.camera import Camera
from recon.model.calibration import PRINT_SCALE, with_scale
from recon.optical_calibration.adjustment import scale_errors
from recon.optical_calibration.joint_calibration import Result

Array = NDArray[np.float64]

BEYOND = 5.0  # standard deviations, from which on a length isn't this board's
CALIPER_MM = 0.03  # standard deviation by a caliper, for which 0.02 mm are claimed
WORTHWHILE = 0.7  # of the scale's standard deviation, that a better way has to reach
WAYS = (  # to a scale that is better known, the cheapest first: relative standard deviations
    ("views of a target whose lengths a microscope gave to 0.002 mm (rig.target)", 5e-5),
    ("a ball bar in five places (bars)", 4e-5),
    ("calibrating by a board of chrome on glass (board_scale)", 1e-5),
)


def with_length(result: Result, scale: float | None, length_mm: tuple[float, float] | None, name: str) -> tuple[Result, float]:
    """A calibration whose scale is as well known as the board's; returns it, and by what ratio lengths have grown.

    Parameters
    ----------
    scale : relative standard deviation of the board's print, as of `recon.model.calibration.with_scale`
    length_mm : of the board's longest line of points, as of `longest`, and its standard deviation; None without

    Raises
    ------
    InputError
        If the length is none of this board, or can't tell the scale.
    """
    adjusted = result.adjustment
    made, cameras = adjusted.calibration, adjusted.calibration.cameras
    assert made.uncertainty is not None
    known, inferred = made.uncertainty, result.tolerances.scale_sigma(result.observations.points) if result.released else 0.0
    prior, step = max(inferred, PRINT_SCALE if scale is None else scale), 0.0
    if length_mm is not None:
        if len(cameras) == 1 or not result.released or prior == 0:
            lacking = (
                "two devices" if len(cameras) == 1 else "a board_scale above 0" if prior == 0 else "a board whose shape is found"
            )
            way = "; a board as designed, or of few poses, has its lengths in its description" if not result.released else ""
            raise InputError(f"{name}: board_length_mm: expected {lacking} beside it, found none{way}")
        length, sigma = length_mm
        found = length_of(adjusted.points, longest(result.observations.points))
        larger, noise = length / found - 1, sigma / found
        usual = float(np.hypot(prior, noise))
        if abs(larger) > BEYOND * usual:
            expected = (
                f"expected {found:.3f} mm within {BEYOND * usual * found:.3f}, by the board's description, found {length:g}"
            )
            cause = "another board or line of points, or from edge to edge? board_scale=... is of a worse print"
            raise InputError(f"{name}: board_length_mm: {expected}: {cause}")
        step, prior = larger * (prior / usual) ** 2, prior * noise / usual
        direction = scale_errors(adjusted.problem, adjusted.estimate) / max(inferred, 1e-12)
        known = replace(known, covariance=known.covariance + (prior**2 - inferred**2) * np.outer(direction, direction))
        cameras = {device: _larger(camera, step) for device, camera in cameras.items()}
        poses = adjusted.poses.copy()
        poses[:, :3, 3] *= 1 + step
        adjusted = replace(adjusted, poses=poses, points=adjusted.points * (1 + step))
    known = with_scale(known, cameras, prior) if len(cameras) > 1 else known
    return replace(result, adjustment=replace(adjusted, calibration=replace(made, cameras=cameras, uncertainty=known))), step


def longest(design: Array) -> tuple[int, int]:
    """Numbers of the first and the last point of the longest row or column of a board : (n, 3) mm."""
    ends, length = (0, 0), -1.0
    for along, across in ((0, 1), (1, 0)):
        _, lines = np.unique(np.round(design[:, across], 3), return_inverse=True)
        for line in range(lines.max() + 1):
            own = np.flatnonzero(lines == line)
            places = design[own, along]
            if np.ptp(places) > length:
                ends, length = (int(own[places.argmin()]), int(own[places.argmax()])), float(np.ptp(places))
    return ends


def length_of(points: Array, ends: tuple[int, int]) -> float:
    """Distance, mm, of two of points : (n, 3) mm by their numbers."""
    return float(np.linalg.norm(points[ends[1]] - points[ends[0]]))


def describe(sigma: float, length_mm: float | None = None) -> str:
    """A line: the relative standard deviation of the scale, and the cheapest way to a better one.

    length_mm : of the board's longest line of points, that a caliper may measure
    """
    ways = WAYS
    if length_mm is not None:
        ways = (
            (f"a caliper over the board's longest line of {length_mm:.0f} mm (board_length_mm)", CALIPER_MM / length_mm),
            *WAYS,
        )
    better = (f"; {way} would make it {1e6 * reached:.0f}" for way, reached in ways if reached <= WORTHWHILE * sigma)
    return f"scale       known to {1e6 * sigma:.0f} ppm{next(better, '')}"


def _larger(camera: Camera, step: float) -> Camera:
    """A device, in a world that is larger by a ratio."""
    place = camera.camera_from_world.copy()
    place[:3, 3] *= 1 + step
    return replace(camera, camera_from_world=place)
