"""A phantom that shows one point at rest, of which nothing else is known: all but its `find`."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.files.metrics import Metrics
from recon.probe_calibration import cross_wire, lateness, point_calibration
from recon.probe_calibration.cross_wire import Crossing
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.point_calibration import MIN_FRAMES, Adjustment, Sightings
from recon.probe_calibration.tank_calibration import Settings

Array = NDArray[np.float64]

__all__ = ["MIN_FRAMES", "SHOWS", "WAYS", "calibrate", "describe", "figures", "misfit", "read", "sight"]
SHOWS = "crossing"
_SCANNER = "another scanner? give appearance."
WAYS = {
    "blurred": f"{_SCANNER}max_sigma_px",
    "only drawn-out echoes": f"{_SCANNER}max_extent_px",
    "no echo stands out": f"{_SCANNER}min_contrast_db",
    "two candidates": f"{_SCANNER}rival_db",
    cross_wire.SEVERAL: "N-wires? give phantom=n_wires and wires=, its definition, or pairs=FILE with one point's pixels; "
    "reverberations? give appearance.rival_db",
}


def read(settings: Settings, reference: str | None) -> None:
    """Nothing is known beforehand."""
    del settings, reference


def sight(seen: Sequence[Crossing], poses: Array, covariance: Array | None, rates: Array | None, lag_sigma_s: float) -> Sightings:
    """The point in n frames."""
    by_lag = lag_sigma_s * rates if lag_sigma_s and rates is not None else None
    seen_there = point_calibration.of_crossings(seen, poses)
    return replace(seen_there, pose_covariance=covariance, pose_by_lag=by_lag, pose_rates=rates)


def misfit(frames: PhantomFrames, settings: Settings) -> float:
    """Mean square distance of the point from one place, as `point_calibration.misfit`."""
    return point_calibration.misfit(frames.sightings, settings.noise)


def calibrate(frames: PhantomFrames, settings: Settings, expected: Array) -> Adjustment:
    """Calibrate by the point, as `point_calibration.calibrate`."""
    return point_calibration.calibrate(
        frames.sightings,
        frames.size,
        settings.noise,
        expected,
        settings.seed,
        settings.echo_ahead_mm,
        settings.echo_ahead_sigma_mm,
        settings.max_sigma_mm,
        frames.numbers[frames.usable],
    )


def figures(found: Adjustment) -> Metrics:
    """The distance of the wires' axes, and what may be mistaken."""
    return {
        "wires_apart_mm": found.apart_mm,
        "frames_that_count_as_one": found.persistence,
        **lateness.figures(found.late),
    }


def describe(found: Adjustment, settings: Settings) -> Iterator[str]:
    """The wires, where they were seen as lines, and what moved."""
    if found.apart_mm:
        ahead = f"their echo taken {settings.echo_ahead_mm:.2f} mm before their axes"
        yield f"wires       seen as lines, the axes {found.apart_mm:.2f} mm apart; {ahead}"
    if found.late is not None and found.late.shown:
        yield f"warning     {found.late.described}"
    if found.moved is not None:
        yield f"warning     {found.moved.described}"
