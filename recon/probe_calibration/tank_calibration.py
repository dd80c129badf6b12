"""Calibration of the probe by crossed wires in a tank of water, for the medium of later sweeps."""

import dataclasses
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from recon.errors import InputError
from recon.model.probe import ProbeCalibration, Speed
from recon.model.rig import Finite, NotNegative, Probe
from recon.probe_calibration import point_calibration, probe_checks, sound_in_water, wires
from recon.probe_calibration.cross_wire import Appearance
from recon.probe_calibration.crossing_frames import CrossingFrames
from recon.probe_calibration.point_calibration import Adjustment, Noise

ORDINARY_C = 22.0  # of water, where no temperature is given


class Settings(BaseModel):
    """The water, the wires, the scanner's assumption, and settings of the method."""

    model_config = ConfigDict(extra="forbid")

    temperature_c: Finite | None = None
    temperature_sigma_c: NotNegative = 1.0
    assumed_speed: Speed = sound_in_water.SCANNER_SPEED
    medium_speed: Speed | None = None
    wire_radius_mm: NotNegative = 0.1
    wire_radius_sigma_mm: NotNegative = 0.03
    wire_speed: Annotated[float, Field(ge=300, le=10000)] = 2600.0
    appearance: Appearance = Appearance()
    noise: Noise = Noise()
    seed: Annotated[int, Field(ge=0)] = 0

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
    def _temperature_of_conversion(self) -> "Settings":
        if self.medium_speed is not None and self.temperature_c is None:
            raise ValueError("medium_speed: expected temperature_c with it, found none")
        return self

    @property
    def wanted_speed(self) -> float:
        """Speed of sound, m/s, that the calibration is converted to where the temperature is known."""
        return self.medium_speed or self.assumed_speed

    @property
    def water_speed(self) -> float:
        """Speed of sound in the tank, m/s, or NaN where no temperature is given."""
        return np.nan if self.temperature_c is None else float(sound_in_water.speed_of_sound(self.temperature_c))

    @property
    def echo_ahead_mm(self) -> float:
        """Distance of the wires' echo before their axes."""
        return self._ahead_of(self.wire_radius_mm)

    @property
    def echo_ahead_sigma_mm(self) -> float:
        """Its standard deviation, by that of the wires' radius."""
        return abs(self._ahead_of(self.wire_radius_sigma_mm))

    def _ahead_of(self, radius_mm: float) -> float:
        temperature = ORDINARY_C if self.temperature_c is None else self.temperature_c
        return wires.echo_ahead(radius_mm, self.wire_speed, float(sound_in_water.speed_of_sound(temperature)))


@dataclass(frozen=True)
class Result:
    """A calibrated probe."""

    adjustment: Adjustment  # in the tank's water
    calibration: ProbeCalibration  # for the medium of later sweeps
    implied_speed: tuple[float, float]  # of sound in the tank by sy, m/s, and its standard deviation


def calibrate(frames: CrossingFrames, design: Probe, settings: Settings) -> Result:
    """Calibrate a probe; `design` holds the rig's.

    Without the temperature the calibration holds for the speed of sound that sy implies.

    Raises
    ------
    InputError
        As `recon.probe_calibration.point_calibration.calibrate`, or if sy implies an impossible speed of sound.
    """
    expected = design.target_from_image.matrix()
    try:
        found = point_calibration.calibrate(
            frames.sightings,
            frames.size,
            settings.noise,
            expected,
            settings.seed,
            settings.echo_ahead_mm,
            settings.echo_ahead_sigma_mm,
        )
        implied = sound_in_water.implied_speed(found.calibration, design.scale_mm_per_px[1], settings.assumed_speed)
        probe_checks.speed(implied[0])
    except InputError as error:
        raise InputError(f"{frames.name}: {error}") from None
    if settings.temperature_c is None:
        return Result(found, replace(found.calibration, speed_m_s=implied[0]), implied)
    sigma = float(sound_in_water.speed_sigma(settings.temperature_c, settings.temperature_sigma_c))
    in_water, wanted = settings.water_speed, settings.wanted_speed
    converted = sound_in_water.in_medium(found.calibration, in_water, wanted, ratio_sigma=wanted / in_water**2 * sigma)
    return Result(found, converted, implied)
