"""Parameters of a rig as measured: by the names of the fields that hold them, with standard deviations and sources."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Estimate:
    """One parameter as measured."""

    value: float
    sigma: float  # standard deviation, in the parameter's unit
    source: str  # what it was measured from, such as `12 fringe images of cam1`


@dataclass(frozen=True)
class Findings:
    """What captures show of a rig, its conditions and its scanner.

    Fields are named as in `conf/`, after their group where that isn't the rig: `cam1.sensor.saturation_e`,
    `conditions.frames.flicker`, `ultrasound.noise_db`.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)  # fields that the captures don't show, and why

    def __or__(self, other: "Findings") -> "Findings":
        """Both; what either measures isn't unknown."""
        estimates = self.estimates | other.estimates
        unknown = {name: why for name, why in (self.unknown | other.unknown).items() if name not in estimates}
        return Findings(estimates, unknown)
