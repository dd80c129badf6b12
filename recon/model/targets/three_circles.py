"""The usual target: c0 the origin, c1 on the x axis, c2 on the y axis or a little beside it."""

from typing import Literal

from recon.model.rig import Finite, Positive, Target


class Kind(Target):
    """A target of three circles."""

    LENGTHS = ("c1_mm", "c2_aside_mm", "c2_mm")
    kind: Literal["three_circles"] = "three_circles"
    c1_mm: Positive  # files have the fields in this order, which need not be that of LENGTHS
    c2_mm: Positive  # along y
    c2_aside_mm: Finite = 0.0  # along x
