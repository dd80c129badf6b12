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
WAYS = (  # to a scale that is better known, the cheapest first: relative standard deviations
    ("views of a target whose lengths a microscope gave to 0.002 mm (rig.target)", 5e-5),
    ("a ball bar in five places (bars)", 3e-5),
    ("a board of chrome on glass (board_scale)", 1e-5),
)


def with_length(result: Result, scale: float | None, row_mm: tuple[float, float] | None, name: str) -> tuple[Result, float]:
    """A calibration whose scale is as well known as the board's; returns it, and by what ratio lengths have grown.

    Parameters
    ----------
    scale : relative standard deviation of the board's print, as of `recon.model.calibration.with_scale`
    row_mm : distance of the first from the last point of the board's longest row, and its standard deviation; None without

    Raises
    ------
    InputError
        If the length is none of this board.
    """
    adjusted = result.adjustment
    made, cameras, inferred = adjusted.calibration, adjusted.calibration.cameras, 0.0
    assert made.uncertainty is not None
    known = made.uncertainty
    if result.released:
        inferred = result.tolerances.scale_sigma(result.observations.points)
    prior, step = max(inferred, PRINT_SCALE if scale is None else scale), 0.0
    if row_mm is not None:
        length, sigma = row_mm
        found = row_length(adjusted.points, result.observations.points)
        larger, noise = length / found - 1, sigma / found
        usual = float(np.hypot(prior, noise))
        if abs(larger) > BEYOND * usual:
            expected = (
                f"expected {found:.3f} mm within {BEYOND * usual * found:.3f}, by the board's description, found {length:g}"
            )
            cause = "another board, or a row from edge to edge? board_scale=... is of a worse print"
            raise InputError(f"{name}: board_row_mm: {expected}: {cause}")
        step, prior = larger * (prior / usual) ** 2, prior * noise / usual
        if result.released:
            direction = scale_errors(adjusted.problem, adjusted.estimate) / max(inferred, 1e-12)
            known = replace(known, covariance=known.covariance + (prior**2 - inferred**2) * np.outer(direction, direction))
        cameras = {device: _larger(camera, step) for device, camera in cameras.items()}
        poses = adjusted.poses.copy()
        poses[:, :3, 3] *= 1 + step
        adjusted = replace(adjusted, poses=poses, points=adjusted.points * (1 + step))
    known = with_scale(known, cameras, prior) if len(cameras) > 1 else known
    return replace(result, adjustment=replace(adjusted, calibration=replace(made, cameras=cameras, uncertainty=known))), step


def row_length(points: Array, design: Array) -> float:
    """Distance, mm, of the first from the last point of a board's longest row, by its points : (n, 3) mm and their design."""
    _, rows = np.unique(np.round(design[:, 1], 3), return_inverse=True)
    lengths = [np.ptp(design[rows == row, 0]) for row in range(rows.max() + 1)]
    longest = np.flatnonzero(rows == int(np.argmax(lengths)))
    first, last = longest[[np.argmin(design[longest, 0]), np.argmax(design[longest, 0])]]
    return float(np.linalg.norm(points[last] - points[first]))


def describe(sigma: float, row_mm: float | None = None) -> str:
    """A line: the relative standard deviation of the scale, and the cheapest way to half of it.

    row_mm : of the board that a caliper may measure
    """
    ways = WAYS
    if row_mm is not None:
        ways = ((f"a caliper over the board's longest row of {row_mm:.0f} mm (board_row_mm)", CALIPER_MM / row_mm), *WAYS)
    better = (f"; {way} would make it {1e6 * reached:.0f}" for way, reached in ways if reached <= sigma / 2)
    return f"scale       known to {1e6 * sigma:.0f} ppm{next(better, '')}"


def _larger(camera: Camera, step: float) -> Camera:
    """A device, in a world that is larger by a ratio."""
    place = camera.camera_from_world.copy()
    place[:3, 3] *= 1 + step
    return replace(camera, camera_from_world=place)
