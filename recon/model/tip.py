"""A tracked tool's tip, and its shaft's direction, in the frame of its target."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TIP, DIMPLE, AXIS = (tuple(f"{what}_{axis}" for axis in "xyz") for what in ("tip", "dimple", "axis"))  # names of parameters


@dataclass(frozen=True)
class Tip:
    """A calibrated tip, by a film or by a drawing. It holds for poses of the target as it was tracked then."""

    tip_mm: Array  # (3,) in the target's frame
    covariance: Array  # (p, p) of `parameters`: mm, and of the axis as it is, of length 1
    axis: Array | None = None  # (3,) in the target's frame, of length 1, from the handle to the tip; None where it isn't known
    dimple_mm: Array | None = None  # (3,) in the world, in which the tip was; None of a drawing's
    rms_mm: float = np.nan  # distance of the tip from the dimple; NaN of a drawing's
    frames: int = 0  # of which the tip was found
    model: Path | None = None  # mesh of the tool, mm in the target's frame
    body: str = ""  # of the rig, that carries the target; empty where it has no name

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the covariance's parameters."""
        return TIP + (DIMPLE if self.dimple_mm is not None else ()) + (AXIS if self.axis is not None else ())

    def covariance_of(self, names: tuple[str, ...]) -> Array:
        """Covariance : (k, k) of some of the parameters."""
        places = [self.parameters.index(name) for name in names]
        return self.covariance[np.ix_(places, places)]
