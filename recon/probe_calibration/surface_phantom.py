"""A phantom that shows the curve of a surface at rest, a wall's or a sphere's: all but its `find` and what is known of it."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from recon.files.metrics import Metrics
from recon.probe_calibration import lateness, surface_calibration
from recon.probe_calibration.echo_curve import Curve
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.surface_calibration import CurveSightings, SurfaceAdjustment
from recon.probe_calibration.tank_calibration import Settings

Array = NDArray[np.float64]


def sight(
    seen: Sequence[Curve], poses: Array, covariance: Array | None, rates: Array | None, lag_sigma_s: float, points: int
) -> CurveSightings:
    """The curve in n frames, by some of its points."""
    nodes = np.array([each.nodes for each in seen]).reshape(-1, points, 2)
    rows = np.array([each.covariance for each in seen]).reshape(-1, points, points)
    return CurveSightings(poses, nodes, rows, covariance, rates, lag_sigma_s)


def calibrate(frames: PhantomFrames, settings: Settings, expected: Array) -> SurfaceAdjustment:
    """Calibrate by the surface; `frames.known` is a sphere's radius, mm, and its standard deviation, None of a wall."""
    return surface_calibration.calibrate(
        frames.sightings,
        frames.size,
        frames.known,
        settings.noise,
        expected,
        settings.max_sigma_mm,
        frames.numbers[frames.usable],
    )


def figures(found: SurfaceAdjustment) -> Metrics:
    """Agreement of frames that weren't used, how much of a mirror the surface is, and what may be mistaken."""
    return {
        "echo_ahead_mm": 0.0,
        "held_out_rms_mm": found.held_out_mm,
        "mirror_share": found.mirror[0],
        "mirror_share_sigma": found.mirror[1],
        "radius_by_arcs_mm": found.radius[0],
        "radius_by_arcs_sigma_mm": found.radius[1],
        "frames_that_count_as_one": found.persistence,
        **lateness.figures(found.late),
    }


def describe(found: SurfaceAdjustment, settings: Settings) -> Iterator[str]:
    """The held-out error, the surface, and all that may be mistaken."""
    if np.isfinite(found.held_out_mm):
        yield f"held out    {found.held_out_mm:.3f} mm (RMS from the surface, odd frames by even ones and back)"
    share, sigma = found.mirror
    by_arcs = ""
    if np.isfinite(found.radius[0]):
        radius, radius_sigma = found.radius
        by_arcs = f"; radius by arcs and motion {radius:.2f} ± {radius_sigma:.2f} mm, given {settings.sphere_radius_mm:g}"
    yield f"surface     a mirror to {100 * share:.0f} ± {100 * sigma:.0f} %{by_arcs}"
    yield from (f"warning     {doubt}" for doubt in found.doubts())
