"""Accuracy of a cylinder's diameter measured by ultrasound in water: slices of a freehand sweep, a tube through them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.model import tracks
from recon.model.probe import ProbeCalibration
from recon.model.rig import Probe, Vector
from recon.probe_calibration import sound_in_water
from recon.segmentation import tube_wall
from recon.segmentation.tube_wall import Appearance, Ring, Tube
from scenes.acoustics import TISSUES
from scenes.kinds import inner_cylinder
from twin.experiments.experiment_setup import Figures, Setup
from twin.ultrasound.bscan import scan, scans
from twin.ultrasound.echo_solids import Body, Wire, body
from twin.ultrasound.probe_path import SurfacePath, along_surface
from twin.ultrasound.sweep_session import surface_of
from twin.ultrasound.timed_sweep import Clocks, Plan, PoseNoise, moments, plan
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

WATER = Transducer(tgc_db_per_cm_mhz=0.0165, gain_db=-40.0)  # conf/ultrasound/water.yaml
WIDER = WATER.model_copy(update={"transmit_f_number": 4.5, "receive_f_number": 3.0})  # apertures of two thirds
TEMPERATURE_C = 22.0
SLICES = 94  # of the paper
PACE_MM_S = 10.0
LENGTH_MM = 46.5  # of the stroke: half a millimetre from slice to slice
STANDOFF_MM = 17.0  # of the face from the wall
WIRE_MM, WIRE_DEPTH_MM = 0.02, 20.0  # a thread's radius, and its depth: that of the wall's flank


@dataclass(frozen=True)
class Stroke:
    """A sweep along the cylinder, as recorded."""

    scene: inner_cylinder.Config
    planned: Plan
    images: list[NDArray[np.uint8]]


def one_sweep(setup: Setup, seed: int) -> Figures:
    """A sweep of as many slices as the paper's."""
    return judged(stroke(setup.rig.probe, SLICES, seed), setup.rig.probe)


def wider_beam(setup: Setup, seed: int = 1, slices: int = SLICES // 2) -> Figures:
    """A beam that isn't the default's, its spread as measured, and what the default's spread would cost."""
    recorded, looks = stroke(setup.rig.probe, slices, seed, WIDER), (Appearance(spread_mm=spread(WIDER)), Appearance())
    speed = float(sound_in_water.speed_of_sound(TEMPERATURE_C))
    tubes = [measured(recorded, setup.rig.probe, speed, look)[1] for look in looks]
    error, unknown = (abs(2 * one.shape.radius - recorded.scene.diameter_mm) for one in tubes)
    across, deep = looks[0].spread_mm
    own = {"error_mm": error, "limit_mm": 2 * tubes[0].sigma_mm, "default_mm": unknown}
    return own | {"slices": len(recorded.images), "across_mm": across, "deep_mm": deep}


def spread(transducer: Transducer) -> tuple[float, float]:
    """Sigma of an echo's power, mm, along the array and in depth, from the widths at half amplitude of a thin wire's echo."""
    half = transducer.width_mm / 2
    ends = np.array([[half, WIRE_DEPTH_MM, -20.0], [half, WIRE_DEPTH_MM, 20.0]])  # square to the image
    thread = Wire("thread", TISSUES["nylon"], ends, WIRE_MM)
    envelope = scan(Body(TISSUES["water"], (), (thread,)), transducer, np.eye(4), 0).envelope
    echo = envelope * (transducer.rows_mm > WIRE_DEPTH_MM / 2)[:, None]  # without the ringing at the face
    row, column = np.unravel_index(echo.argmax(), echo.shape)
    widths = half_width(echo[row]), half_width(echo[:, column])
    across, deep = (step * width / (2.355 * np.sqrt(2)) for step, width in zip(transducer.scale_mm_per_px, widths, strict=True))
    return float(across), float(deep)


def half_width(profile: NDArray) -> float:
    """Full width at half maximum, in samples, of the highest peak of a profile : (n,) that ends below half."""
    top = int(profile.argmax())
    below = np.flatnonzero(profile < profile[top] / 2)
    i, j = below[below < top][-1], below[below > top][0]
    left = i + (profile[top] / 2 - profile[i]) / (profile[i + 1] - profile[i])
    right = j - (profile[top] / 2 - profile[j]) / (profile[j - 1] - profile[j])
    return float(right - left)


def stroke(probe: Probe, slices: int, seed: int, transducer: Transducer = WATER) -> Stroke:
    """Lead the probe by hand along the middle of the cylinder, its array across, and take images at the scanner's rate."""
    config, clocks = inner_cylinder.Config(), Clocks(scanner_hz=rate_hz(slices))
    made = body(inner_cylinder.build(config))
    course = along_surface(path_along(config.centre_mm), surface_of("inner", made), transducer, seed)
    planned = plan(probe, course, moments(course, clocks.scanner_hz), clocks, PoseNoise(), seed)
    return Stroke(config, planned, [one.image for one in scans(made, transducer, planned.truth.poses, seed)])


def rate_hz(slices: int) -> float:
    """Images a second for so many along the stroke."""
    return (slices - 1) * PACE_MM_S / LENGTH_MM


def path_along(centre_mm: Vector) -> SurfacePath:
    """The stroke over the middle of a cylinder along x, the array across."""
    x, y, _ = centre_mm
    half = LENGTH_MM / 2 + 0.1  # for the last image, too
    return SurfacePath(start_mm=(x - half, y), end_mm=(x + half, y), speed_mm_s=PACE_MM_S, turn_deg=90.0, standoff_mm=STANDOFF_MM)


def measured(recorded: Stroke, probe: Probe, speed: float, look: Appearance | None = None) -> tuple[list[Ring], Tube]:
    """Rings and tube as the pipeline finds them: the lag is known, and so is the speed of sound, m/s."""
    scanner = ProbeCalibration(probe.target_from_image.matrix(), np.array(probe.scale_mm_per_px))
    calibration = sound_in_water.in_medium(scanner, WATER.assumed_speed, speed)
    lag_ns = round(1e9 * Clocks().lag_s)
    world_from_target = tracks.at(recorded.planned.track, recorded.planned.times - lag_ns)
    world_from_pixel = world_from_target @ calibration.target_from_image @ np.diag([*calibration.scale, 1.0, 1.0])
    rings = [tube_wall.find(image, calibration.scale, look) for image in recorded.images]
    return rings, tube_wall.fit_tube(rings, world_from_pixel)


def judged(recorded: Stroke, probe: Probe) -> Figures:
    """Errors of one sweep's tube."""
    rings, tube = measured(recorded, probe, float(sound_in_water.speed_of_sound(TEMPERATURE_C)))
    return {
        "slices": len(rings),
        "error_mm": abs(2 * tube.shape.radius - recorded.scene.diameter_mm),
        "limit_mm": 2 * tube.sigma_mm,
        "found": np.mean([one.found for one in rings]),
        "turn_deg": np.rad2deg(np.arccos(min(abs(tube.shape.axis[0]), 1.0))),
        "aside_mm": np.linalg.norm((tube.shape.point - recorded.scene.centre_mm)[1:]),
        "rms_mm": tube.rms,
    }
