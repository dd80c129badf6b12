"""A needle: a steel shaft in a handle, the target's board on a bracket at its rear, and a hand that pinches the handle."""

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from recon.geometry import rigid
from recon.model.rig import Finite, NotNegative, Positive, Target
from scenes.acoustics import TISSUES
from scenes.handheld import lofts
from scenes.handheld.held_tool import HeldTool, open_side, tinted
from scenes.handheld.mesh_parts import Part
from scenes.handheld.shaft import Shaft
from scenes.tissue import Tissue

Array = NDArray[np.float64]

# outer and inner diameters, mm [ISO 9626, normal-walled tubing for needles]
DIAMETERS_MM = {14: 2.11, 15: 1.83, 16: 1.65, 17: 1.47, 18: 1.27, 19: 1.07, 20: 0.91, 21: 0.82, 22: 0.72, 23: 0.64, 25: 0.51}
BORES_MM = {14: 1.60, 15: 1.37, 16: 1.19, 17: 1.07, 18: 0.84, 19: 0.69, 20: 0.60, 21: 0.51, 22: 0.41, 23: 0.34, 25: 0.26}
AIR = Tissue(0.0004, 343.0, 0.0, None)


class Kind(HeldTool):
    """A needle in a hand."""

    kind: Literal["needle"] = "needle"
    gauge: Annotated[int, Field(ge=14, le=25)] = 17
    """thickness of the shaft, by ISO 9626: 14 is 2.1 mm, 25 is 0.5 mm"""
    mark_mm: Positive = 10.0
    """from one mark on the shaft to the next"""
    bevel_deg: Annotated[float, Field(ge=8, le=80)] = 17.0
    """angle of the ground tip to the shaft: 11 of a regular bevel, 17 of a short one [ISO 7864]"""
    bevel_turn_deg: Finite = 0.0
    """of the side on which the bevel is open about the shaft, from that of the board's face"""
    filling: Literal["stylet", "water", "air"] = "stylet"
    """of the bore; a stylet makes it a solid rod"""
    roughness_um: Annotated[float, Field(ge=0, le=100)] = 1.0
    """standard deviation of the steel's surface, assumed for a drawn tube; what shines at no angle, sound scatters by this"""
    etched_mm: NotNegative = 0.0
    """length from the tip that is made rough, to be seen at any angle; 0 is none"""
    etched_um: Annotated[float, Field(ge=0, le=100)] = 20.0
    """standard deviation of that; a tenth of a wavelength scatters nearly all"""

    @field_validator("gauge")
    @classmethod
    def _made(cls, value: int) -> int:
        if value not in DIAMETERS_MM:
            raise ValueError(f"expected one of {', '.join(map(str, DIAMETERS_MM))}, found {value}")
        return value

    @model_validator(mode="after")
    def _bevel_on_shaft(self) -> "Kind":
        bevel = DIAMETERS_MM[self.gauge] / np.tan(np.deg2rad(self.bevel_deg))
        if bevel > self.length_mm:
            raise ValueError(
                f"bevel_deg: expected a bevel of at most length_mm = {self.length_mm:g}, found one of {bevel:.1f} mm"
            )
        return self

    def shaft(self, target: Target) -> Shaft:
        """The tube, with its bevel's point at the tip."""
        _, along = self.axis(target)
        bore = 0.0 if self.filling == "stylet" else BORES_MM[self.gauge] / 2
        return Shaft(
            self.tip_mm(target), along, open_side(along, self.bevel_turn_deg), self.length_mm, DIAMETERS_MM[self.gauge] / 2,
            replace(TISSUES["steel"], roughness=1e-3 * self.roughness_um), bore, AIR if self.filling == "air" else None,
            "bevel", np.deg2rad(self.bevel_deg), 0.0, self.etched_mm, 1e-3 * self.etched_um,
        )  # fmt: skip

    def steel(self, start: Array, along: Array) -> list[Part]:
        """Steel tube with a pointed end, and dark marks on it."""
        radius = DIAMETERS_MM[self.gauge] / 2
        profile = [(radius, -3), (radius, self.length_mm - 5 * radius), (0.05, self.length_mm)]
        levels = np.concatenate([np.linspace(profile[k][1], profile[k + 1][1], 8)[k > 0 :] for k in (0, 1)])
        steel = lofts.turned(np.column_stack([np.interp(levels, *np.array(profile).T[::-1]), levels]), 20)
        marks = [
            lofts.placed(lofts.rod(radius + 0.02, 1.0, 20, 0.01), rigid.transform(np.eye(3), [0, 0, at]))
            for at in np.arange(self.mark_mm, self.length_mm - 6 * radius, self.mark_mm)
        ]
        to_shaft = lofts.frame(start, along)
        dark = [tinted("metal", lofts.placed(mark, to_shaft), 0.05) for mark in marks]
        return [tinted("metal", lofts.placed(steel, to_shaft), 0.45), *dark]
