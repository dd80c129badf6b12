"""Settings that several steps share: each with its default, its bounds, its unit and its text, once."""

import os
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, model_validator

from recon.model.rig import NotNegative, Part, Positive, Probe
from recon.segmentation.blur_correction import MOST_MM, Blur
from recon.segmentation.detectability import Sought
from recon.segmentation.echo_power import SLICE_MM, SPREAD_MM
from recon.segmentation.insonation import Spread as Spreads

Spread = Annotated[float, Field(gt=0, le=MOST_MM)]
Spacing = Annotated[float, Field(ge=0.01, le=100)]  # mm, of a volume's voxels
OF_THE_SCALE = "rig.probe.scale_mm_per_px"


class BoardField(Part):
    """The field of a step whose lengths are those of a calibration board."""

    board_scale: Annotated[float, Field(ge=0, le=0.1)] | None = None
    """relative standard deviation of the scale of the board that the cameras were calibrated with, at least: 3e-4 of paper, by
    moisture; 1e-5 of chrome on glass. null: what the calibration says, and that of paper where it says nothing"""


def _check_sigma(name: str, known: tuple[float, float] | None) -> None:
    """Check that a length is no pair of lengths."""
    worst = 0.01  # of a length, that a standard deviation may be
    if known is not None and known[1] > worst * known[0]:
        expected = f"expected a length and its standard deviation, at most {100 * worst:g} % of it"
        raise ValueError(f"{name}: {expected}, found {list(known)}: two lengths?")


class BoardLengthField(Part):
    """The field of a step that calibrates by a board of which one length was measured."""

    board_length_mm: tuple[Positive, Positive] | None = None
    """mm, distance of the first from the last point of the board's longest row or column, as measured, and its standard
    deviation: [150.1,0.03]. Of discs by a caliper, the mean of outer and inner edges; of asymmetric circles the column through
    every other row, the first one. It gives the scale, which else is the description's"""

    @model_validator(mode="after")
    def _exact_enough(self) -> "BoardLengthField":
        _check_sigma("board_length_mm", self.board_length_mm)
        return self


class BarFields(Part):
    """Fields of a step that corrects the scale by a ball bar."""

    bars: tuple[Path, ...] = ()
    """capture folders with fringes and a code (such as patterns=gray_surface) before camera 1 of a ball bar, two balls of matt
    paint, which gives the scale: one, or better some, with the bar in other places; taken on the same day, before or after"""
    bar_mm: tuple[Positive, Positive] | None = None
    """mm, certified distance of the balls' centres, and its standard deviation: [150.012,0.002]"""
    ball_mm: Positive = 25.4
    """mm, diameter of the balls, within 5 %"""

    @model_validator(mode="after")
    def _certified(self) -> "BarFields":
        if bool(self.bars) != (self.bar_mm is not None):
            lacking, given = ("bar_mm", "bars") if self.bars else ("bars", "bar_mm")
            raise ValueError(f"{lacking}: expected beside {given}, found nothing")
        if len({os.path.realpath(path) for path in self.bars}) < len(self.bars):
            raise ValueError("bars: expected each capture once, found one twice")
        _check_sigma("bar_mm", self.bar_mm)
        return self


class TargetField(Part):
    """The field of a step that tracks the target as it was measured, if it was."""

    target: Path | None = None
    """file of `sonotwin calibrate-target`: the target as it was measured, instead of the design's"""


class BodyTargetFields(Part):
    """The field of a step that tracks further bodies, of which the targets may have been measured."""

    measured: dict[str, Path] = Field(default_factory=dict)
    """files of `sonotwin calibrate-target` by names of rig.bodies, instead of their designs: measured.needle=FILE"""


def _rising(value: tuple[tuple[float, float], ...] | None) -> tuple[tuple[float, float], ...] | None:
    depths = [depth for depth, _ in value or ()]
    if any(second <= first for first, second in pairwise(depths)):
        raise ValueError(f"expected rising depths, found {depths}")
    return value


class EchoFields(Part):
    """Fields of a step that corrects what it finds in B-scans for the extent of echoes."""

    spread_mm: tuple[Spread, Spread] = SPREAD_MM
    """mm, sigma of an echo's power along the array and in depth; both move a tube's bent wall, the first flattens masses'
    lobes and blurs their shadows. These are the default array's. To measure them: the half-maximum width of a thin wire's
    echo amplitude there, over 2.355 * sqrt(2)"""
    slice_mm: Annotated[tuple[tuple[NotNegative, Spread], ...] | None, AfterValidator(_rising)] = SLICE_MM
    """mm, depth and sigma of an echo's power across the image plane there, which flattens masses' lobes; these are the default
    array's. To measure it: the half-maximum width, across the plane, of the echo amplitude of a thin wire or of an inclined
    sheet (IEC 61391-1) at some depths, over 2.355 * sqrt(2). [] takes an infinitely thin slice, and null leaves lobes as
    flat as they are found, and edges of shadows sharp"""

    @property
    def blur(self) -> Blur | None:
        """Blur of the B-scans that masses are corrected for."""
        return None if self.slice_mm is None else Blur(self.spread_mm[0], self.slice_mm)

    @property
    def spreads(self) -> Spreads:
        """Extent of an echo in all three directions; across the plane that of the default array where it isn't given."""
        return Spreads(*self.spread_mm, SLICE_MM if self.slice_mm is None else self.slice_mm)


class SoughtFields(Part):
    """Fields of a step that maps what was seen: the mass that would have been found there."""

    seen_mm: Annotated[float, Field(ge=1, le=100)] = Sought.size_mm
    """mm, diameter of a mass, for which places count as seen or not"""
    seen_db: Annotated[float, Field(ge=0.5, le=60)] = Sought.contrast_db
    """dB, by which that mass is darker than the tissue"""

    @property
    def sought(self) -> Sought:
        """That mass."""
        return Sought(self.seen_mm, self.seen_db)


class ScaleFields(Part):
    """The field of a step that reads rig.probe's scale, which counts otherwise where it was given."""

    scale_given: bool = False
    """whether rig.probe.scale_mm_per_px is the scanner's even where it is the usual rig's; true by itself where it is given"""

    @model_validator(mode="before")
    @classmethod
    def _knows_what_was_given(cls, values: Any, info: ValidationInfo) -> Any:
        names = {each.lstrip("+~").partition("=")[0] for each in (info.context or {}).get("overrides", ())}
        given = names & {"rig", "rig.probe", OF_THE_SCALE} and isinstance(values, dict)
        return {**values, "scale_given": True} if given else values

    def scanner_sy(self, given: Probe, usual: Probe) -> float | None:
        """The scanner's mm/px in depth: as given; NaN where only the size was, so of another scanner; None for the usual."""
        if self.scale_given or given.scale_mm_per_px != usual.scale_mm_per_px:
            return given.scale_mm_per_px[1]
        return None if given.image_size == usual.image_size else np.nan
