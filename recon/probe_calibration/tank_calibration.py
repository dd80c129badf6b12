"""Calibration of the probe by a phantom in a tank of water, for the medium of later sweeps."""

import dataclasses
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PlainValidator, field_validator, model_validator

from recon import registry
from recon.errors import InputError
from recon.model.probe import SPEEDS, ProbeCalibration, Speed, SpeedSigma
from recon.model.rig import Finite, NotNegative, Part, Probe
from recon.probe_calibration import misreadings, probe_checks, sound_in_water, wires
from recon.probe_calibration.cross_wire import Appearance
from recon.probe_calibration.phantom_frames import CROSSED_WIRES, PHANTOMS, STYLUS, Adjusted, PhantomFrames
from recon.probe_calibration.point_calibration import Noise

Phantom = Annotated[str, PlainValidator(partial(registry.known, PHANTOMS))]
OWN = {  # fields that one phantom alone has
    STYLUS: ("tip", "tip_radius_mm", "tip_radius_sigma_mm"),
    "sphere": ("sphere_radius_mm", "sphere_radius_sigma_mm"),
}
ORDINARY_C = 22.0  # of water, where no temperature is given
SAME_WIDTH = 0.05  # relative difference of sx, which no sound changes, within which a B-scan is of the rig's scanner


class Settings(Part):
    """The water, the wires, the scanner's assumption, and settings of the method."""

    temperature_c: Finite | None = None
    """deg C, of the water. Null leaves sy as measured, mm of this water a pixel: right for sweeps through the same water.
    Given, depths are converted to medium_speed, for sweeps through tissue"""
    temperature_sigma_c: NotNegative = 1.0
    """deg C, standard deviation of the thermometer, and of the water where it isn't; 2.8 m/s a degree at 22 deg C"""
    tank_speed: Speed | None = None
    """m/s, of sound in the tank, in place of temperature_c: measured, or of another liquid"""
    tank_speed_sigma: SpeedSigma = 3.0
    """m/s, its standard deviation"""
    assumed_speed: Speed = sound_in_water.SCANNER_SPEED
    """m/s, by which the scanner turns delays into depths; nearly all take this mean of soft tissues"""
    medium_speed: Speed | None = None
    """m/s, of what will be scanned; needs temperature_c or tank_speed. Null is assumed_speed; `freehand` and `segment` can
    convert too"""
    face_row: Annotated[float, Field(ge=0, le=1e4)] | None = None
    """px, row of the images at which echoes have no delay, from which depths count: on an uncropped screen that of the
    B-scan's first row. Null is the clip's first row, 0 without a clip"""
    phantom: Phantom = CROSSED_WIRES
    """what the tank holds: a module of recon/probe_calibration/phantoms, which finds it in a B-scan"""
    wires: Path | None = None
    """of n_wires: a PLUS configuration that defines them, .xml; null is PLUS's phantom fCal 2, of three N-wires"""
    registration: Literal["known", "free"] | None = None
    """of n_wires: known holds the phantom's pose in the reference frame as wires has it, PhantomToReference; free finds it by the
    motion of the probe alone, which needs turns about two axes. Null is known for a sequence where there is one"""
    registration_sigma_mm: Annotated[float, Field(gt=0, le=100)] = 0.5
    """mm, standard deviation of a known registration along each axis; PLUS has its error as Error"""
    wire_place_sigma_mm: Annotated[float, Field(gt=0, le=10)] = 0.1
    """mm, standard deviation of the places of n_wires in their phantom; assumed, of holes that are printed or drilled"""
    wire_radius_mm: NotNegative = 0.1
    """mm; assumed, an ordinary fishing line. The echo comes from before the axis: 0.04 mm for nylon of this radius"""
    wire_radius_sigma_mm: NotNegative = 0.03
    """mm, its standard deviation; assumed: lines of 0.14 to 0.26 mm are sold side by side"""
    wire_speed: Annotated[float, Field(ge=300, le=10000)] = 2600.0
    """m/s, of sound in the wire; nylon. Steel makes 5900"""
    body: str | None = None
    """of a capture: name of the tracked body that the phantom rests on, as the tip of a stylus does; null is the world"""
    tip: Path | None = None
    """of stylus: its tip.yaml, of `sonotwin calibrate-tip`; null finds the tip with the probe, turned about two axes"""
    tip_radius_mm: Annotated[float, Field(ge=0, le=10)] = 0.0
    """mm, of stylus: by which its echo comes from before the tip: the radius of a ball, or of a shaft that is cut off square"""
    tip_radius_sigma_mm: NotNegative = 0.05
    """mm, its standard deviation; assumed"""
    sphere_radius_mm: Annotated[float, Field(ge=1, le=500)] | None = None
    """mm, of sphere, which needs it"""
    sphere_radius_sigma_mm: Annotated[float, Field(gt=0, le=10)] = 0.05
    """mm, its standard deviation, which goes into the depth; assumed, of callipers"""
    max_sigma_mm: Annotated[float, Field(gt=0, le=100)] = probe_checks.MAX_SIGMA_MM
    """mm, greatest standard deviation, in any direction, of the place of a pixel; what is known less well is refused"""
    appearance: Appearance = Appearance()
    """what a crossing looks like"""
    noise: Noise = Noise()
    """standard deviations, per axis, of what has no covariance of its own; their proportions count"""
    seed: Annotated[int, Field(ge=0)] = 0
    """of the random draws of frames for the robust start"""

    @field_validator("appearance", "noise")
    @classmethod
    def _above_zero(cls, value: Appearance | Noise) -> Appearance | Noise:
        for name, numbers in dataclasses.asdict(value).items():
            if not (np.isfinite(numbers).all() and np.min(numbers) >= 0):
                raise ValueError(f"{name}: expected finite numbers from 0 on, found {numbers}")
        return value

    @field_validator("appearance")
    @classmethod
    def _of_a_scanner(cls, value: Appearance) -> Appearance:
        if not 20 <= value.dynamic_range_db <= 120:
            raise ValueError(f"dynamic_range_db: expected 20 to 120 dB, found {value.dynamic_range_db:g}")
        return value

    @field_validator("noise")
    @classmethod
    def _some(cls, value: Noise) -> Noise:
        if not any(dataclasses.astuple(value)):
            raise ValueError("expected one standard deviation above zero at least, found none: their proportions count")
        return value

    @model_validator(mode="after")
    def _one_speed_of_the_tank(self) -> "Settings":
        if self.tank_speed is not None and self.temperature_c is not None:
            raise ValueError("tank_speed: expected without temperature_c, found both")
        if self.medium_speed is not None and not self.tank_known:
            raise ValueError("medium_speed: expected temperature_c or tank_speed with it, found none")
        return self

    @model_validator(mode="after")
    def _of_wires(self) -> "Settings":
        for name in ("wires", "registration"):
            if getattr(self, name) is not None and self.phantom == CROSSED_WIRES:
                raise ValueError(
                    f"{name}: expected none with phantom={self.phantom}, found {getattr(self, name)}: phantom=n_wires?"
                )
        return self

    @model_validator(mode="after")
    def _of_one_phantom(self) -> "Settings":
        for phantom, names in OWN.items():
            for name in names:
                value = getattr(self, name)
                if self.phantom != phantom and value != type(self).model_fields[name].default:
                    found = f"{value:g}" if isinstance(value, float) else value
                    raise ValueError(f"{name}: expected none with phantom={self.phantom}, found {found}: phantom={phantom}?")
        return self

    @property
    def wanted_speed(self) -> float:
        """Speed of sound, m/s, that the calibration is converted to where that of the tank is known."""
        return self.medium_speed or self.assumed_speed

    @property
    def tank_known(self) -> bool:
        """Whether the speed of sound in the tank is given, by itself or by the temperature."""
        return self.tank_speed is not None or self.temperature_c is not None

    @property
    def water_speed(self) -> float:
        """Speed of sound in the tank, m/s, or NaN where neither it nor the temperature is given."""
        if self.temperature_c is None:
            return np.nan if self.tank_speed is None else self.tank_speed
        return float(sound_in_water.speed_of_sound(self.temperature_c))

    @property
    def water_speed_sigma(self) -> float:
        """Its standard deviation, m/s."""
        if self.temperature_c is None:
            return self.tank_speed_sigma
        return float(sound_in_water.speed_sigma(self.temperature_c, self.temperature_sigma_c))

    @property
    def echo_ahead_mm(self) -> float:
        """Distance of the wires' echo before their axes, or of a stylus' before its tip."""
        return self.tip_radius_mm if self.phantom == STYLUS else self._ahead_of(self.wire_radius_mm)

    @property
    def echo_ahead_sigma_mm(self) -> float:
        """Its standard deviation, by that of the radius."""
        return self.tip_radius_sigma_mm if self.phantom == STYLUS else abs(self._ahead_of(self.wire_radius_sigma_mm))

    def _ahead_of(self, radius_mm: float) -> float:
        speed = self.water_speed if self.tank_known else float(sound_in_water.speed_of_sound(ORDINARY_C))
        return wires.echo_ahead(radius_mm, self.wire_speed, speed)


@dataclass(frozen=True)
class Result:
    """A calibrated probe."""

    adjustment: Adjusted  # in the tank's water
    calibration: ProbeCalibration  # for the medium of later sweeps
    shown_sy: float  # mm/px by which the scanner draws depths; NaN if unknown
    implied_speed: tuple[float, float]  # of sound in the tank by both sy, m/s, and its standard deviation; NaN likewise
    wider: float = 1.0  # times sx is the design's, in images of its size, where nothing else tells the scanner's


def calibrate(frames: PhantomFrames, design: Probe, settings: Settings, scanner_sy: float | None = None) -> Result:
    """Calibrate a probe; `design` holds the rig's.

    Without the tank's speed of sound the calibration holds for the one that sy implies.

    Parameters
    ----------
    scanner_sy : float, mm/px
        By which this scanner draws depths; NaN if unknown. Without it the design's counts, if the B-scans are of its scanner: of
        the same size and of the same sx.

    Raises
    ------
    InputError
        As the phantom's `calibrate`, or if sy implies an impossible speed of sound, or if neither the
        tank's speed nor the scanner's scale is known.
    """
    expected = design.target_from_image.matrix()
    face_row = frames.first_row if settings.face_row is None else settings.face_row
    try:
        found = _calibrate(frames, settings, expected)
        found = replace(found, calibration=replace(found.calibration, face_row=float(face_row)))
        shown_sy = _design_sy(found.calibration, frames.size, design) if scanner_sy is None else scanner_sy
        implied = sound_in_water.implied_speed(found.calibration, shown_sy, settings.assumed_speed)
        if not settings.tank_known:
            probe_checks.scanner_scale(implied[0], found.calibration)
        probe_checks.speed(implied[0], found.calibration, SPEEDS if settings.tank_known else probe_checks.WATER)
    except probe_checks.Misread:
        raise
    except InputError as error:
        raise InputError(f"{frames.name}: {error}") from None
    designed = scanner_sy is None and frames.size == design.image_size
    wider = float(found.calibration.scale[0] / design.scale_mm_per_px[0]) if designed else 1.0
    if not settings.tank_known:
        return Result(found, replace(found.calibration, speed_m_s=implied[0]), shown_sy, implied, wider)
    in_water, wanted = settings.water_speed, settings.wanted_speed
    ratio_sigma = wanted / in_water**2 * settings.water_speed_sigma
    converted = sound_in_water.in_medium(found.calibration, in_water, wanted, ratio_sigma=ratio_sigma)
    return Result(found, converted, shown_sy, implied, wider)


def _calibrate(frames: PhantomFrames, settings: Settings, expected: NDArray[np.float64]) -> Adjusted:
    """As the phantom's `calibrate`, or the likely mistake in what it refuses, or in two parts that outliers hide."""
    kind = registry.kind(PHANTOMS, frames.phantom)
    try:
        found = kind.calibrate(frames, settings, expected)
    except probe_checks.Misread as error:
        likely = misreadings.explain(frames, kind, settings, expected, error.how) if hasattr(kind, "misfit") else ""
        raise probe_checks.Misread(f"{frames.name}: {error.fault}", error.how, likely) from None
    outliers = found.outliers
    least = misreadings.FEWEST_AFTER if found.moved is None else misreadings.MANY * len(outliers)  # a movement is of both parts
    if outliers.sum() < least or not hasattr(kind, "misfit"):
        return found
    if parts := misreadings.two_parts(frames, outliers, kind, settings):
        fault = f"{outliers.sum()} of {len(outliers)} that don't with the others"
        raise probe_checks.Misread(f"{frames.name}: sightings: expected frames that agree, found {fault}", likely=parts)
    return found


def _design_sy(found: ProbeCalibration, size: tuple[int, int], design: Probe) -> float:
    """The design's mm/px in depth, or NaN where the B-scans are of another scanner, or at another depth setting."""
    sx, sy = design.scale_mm_per_px
    return sy if size == design.image_size and abs(found.scale[0] / sx - 1) < SAME_WIDTH else np.nan
