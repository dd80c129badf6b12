"""A stylus: a solid rod of steel with a ball or a point at its end, which points at places, in air and in water."""

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from recon.geometry import rigid
from recon.model.rig import NotNegative, Target
from scenes.acoustics import TISSUES
from scenes.handheld import lofts
from scenes.handheld.held_tool import HeldTool, open_side, tinted
from scenes.handheld.mesh_parts import Part
from scenes.handheld.shaft import Shaft

Array = NDArray[np.float64]


class Kind(HeldTool):
    """A stylus in a hand."""

    kind: Literal["stylus"] = "stylus"
    diameter_mm: Annotated[float, Field(ge=0.5, le=8)] = 2.0
    """of the rod"""
    ball_mm: NotNegative = 3.0
    """diameter of the ball at its end, which the tip is the foremost point of; 0 is a point"""
    point_deg: Annotated[float, Field(ge=5, le=80)] = 20.0
    """of a point's side to the rod's axis"""
    roughness_um: Annotated[float, Field(ge=0, le=100)] = 2.0
    """standard deviation of the steel's surface; assumed for a turned rod"""

    @model_validator(mode="after")
    def _ball_on_rod(self) -> "Kind":
        if self.ball_mm and not self.diameter_mm <= self.ball_mm <= 20:
            raise ValueError(f"ball_mm: expected 0, or diameter_mm = {self.diameter_mm:g} to 20, found {self.ball_mm:g}")
        return self

    @model_validator(mode="after")
    def _point_on_rod(self) -> "Kind":
        point = self.diameter_mm / 2 / np.tan(np.deg2rad(self.point_deg))
        if not self.ball_mm and point > self.length_mm:
            raise ValueError(
                f"point_deg: expected a point of at most length_mm = {self.length_mm:g}, found one of {point:.1f} mm"
            )
        return self

    def shaft(self, target: Target) -> Shaft:
        """The rod, its foremost point at the tip."""
        _, along = self.axis(target)
        steel = replace(TISSUES["steel"], roughness=1e-3 * self.roughness_um)
        kind, angle = "ball" if self.ball_mm else "cone", float(np.deg2rad(self.point_deg))
        return Shaft(
            self.tip_mm(target), along, open_side(along, 0.0), self.length_mm, self.diameter_mm / 2, steel,
            kind=kind, angle=angle, ball=self.ball_mm / 2,
        )  # fmt: skip

    def steel(self, start: Array, along: Array) -> list[Part]:
        """Rod, and ball or point."""
        radius, to_shaft = self.diameter_mm / 2, lofts.frame(start, along)
        point = radius / np.tan(np.deg2rad(self.point_deg))
        end = (
            [(radius, self.length_mm - point), (0.05, self.length_mm)]
            if not self.ball_mm
            else [(radius, self.length_mm - radius)]
        )
        parts = [tinted("metal", lofts.placed(lofts.turned(np.array([(radius, -3.0), (radius, 0.0), *end]), 24), to_shaft), 0.4)]
        if self.ball_mm:
            turn = np.linspace(-np.pi / 2, np.pi / 2, 24)
            ball = lofts.turned(self.ball_mm / 2 * np.column_stack([np.cos(turn), np.sin(turn)]), 32)
            to_ball = to_shaft @ rigid.transform(np.eye(3), [0, 0, self.length_mm - self.ball_mm / 2])
            parts.append(tinted("metal", lofts.placed(ball, to_ball), 0.4))
        return parts
