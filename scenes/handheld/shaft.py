"""The shaft of a tool as sound meets it: a rod or a tube of a material, with a tip, in the frame of the tool's target."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from scenes.tissue import Tissue

Array = NDArray[np.float64]

Tip = Literal["bevel", "cone", "ball"]


@dataclass(frozen=True, eq=False)
class Shaft:
    """A straight, round, rigid shaft.

    A bevel is a plane cut through the whole tube, with its point on the wall. Cones and balls end on the axis; a ball is at
    least as thick as the shaft.
    """

    tip: Array  # (3,) mm, the foremost point
    along: Array  # (3,) unit, from the rear end to the tip
    up: Array  # (3,) unit, across it: the side on which a bevel is open
    length: float  # mm
    radius: float  # mm
    material: Tissue  # its roughness that of the polished surface
    bore: float = 0.0  # mm, radius; 0 is solid
    filling: Tissue | None = None  # of the bore
    kind: Tip = "cone"
    angle: float = np.deg2rad(20.0)  # rad, of a bevel or a cone's side to the axis
    ball: float = 0.0  # mm, its radius
    etched: float = 0.0  # mm from the tip, which are rougher
    etched_roughness: float = 0.0  # mm, standard deviation

    @property
    def foremost(self) -> Array:
        """Where the axis ends, beside or at the tip : (3,) mm."""
        return self.tip + self.radius * self.up if self.kind == "bevel" else self.tip

    @property
    def ends(self) -> Array:
        """Ends of the axis : (2, 3) mm, the rear one first."""
        return np.stack([self.foremost - self.length * self.along, self.foremost])

    def moved(self, to_from: Array) -> "Shaft":
        """The same in another frame."""
        along, up = rigid.rotate(to_from, np.stack([self.along, self.up]))
        return replace(self, tip=rigid.apply(to_from, self.tip), along=along, up=up)
