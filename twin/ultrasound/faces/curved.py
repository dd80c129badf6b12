"""The face of a curved array."""

from typing import Annotated

import numpy as np
from pydantic import Field

from recon.model.rig import Part


class Face(Part):
    """An arc, whose lines leave it at right angles, evenly spaced."""

    radius_mm: Annotated[float, Field(ge=5, le=500)]
    sector_deg: Annotated[float, Field(ge=1, le=170)]  # between the first line and the last
    lines: Annotated[int, Field(ge=16, le=2048)]

    @property
    def pitch_mm(self) -> float:
        """From line to line on the face."""
        return self.radius_mm * np.deg2rad(self.sector_deg) / (self.lines - 1)

    @property
    def bend(self) -> float:
        """Of the arc, 1/mm."""
        return 1 / self.radius_mm

    @property
    def sagitta_mm(self) -> float:
        """By which the middle of the face stands out before its ends."""
        return float(self.radius_mm * (1 - np.cos(np.deg2rad(self.sector_deg / 2))))

    @property
    def chord_mm(self) -> float:
        """From end to end."""
        return float(2 * self.radius_mm * np.sin(np.deg2rad(self.sector_deg / 2)))

    @property
    def foot_mm(self) -> float:
        """Width of what touches the skin: the whole arc's, from end to end."""
        return self.chord_mm
