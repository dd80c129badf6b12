"""How the tracking cameras are set, and how finely their frames are rendered. No renderer."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from recon.model.rig import Part, Positive


def power_of_two(value: int) -> int:
    """Check a number of rays; ValueError if it is no power of two."""
    if value & (value - 1):
        raise ValueError(f"expected a power of two, found {value}")
    return value


class Quality(Part):
    """Rays a pixel, powers of two."""

    view: int = Field(default=1, ge=1, le=256)  # of each of the four camera pixels that make a view's pixel
    patch: int = Field(default=4, ge=2, le=1024)
    window: int = Field(default=4, ge=2, le=1024)  # of full frames, and of what a sketch shows in full

    _power_of_two = field_validator("view", "patch", "window")(power_of_two)


class FilmQuality(Part):
    """Rays a pixel of a film's frames, powers of two."""

    view: int = Field(default=1, ge=1, le=256)
    """of each pixel of what stands still, once a film, of cells of 8 px in each frame, and of 2 px about bodies and in shadows"""
    outline: int = Field(default=4, ge=2, le=256)
    """of each pixel of outlines"""
    disc: int = Field(default=1, ge=1, le=256)
    """of each pixel of the circles"""
    rim: int = Field(default=8, ge=2, le=1024)
    """of those at their rims, and of every pixel of full frames"""

    _power_of_two = field_validator("view", "outline", "disc", "rim")(power_of_two)


class Shooting(Part):
    """Exposure of the tracking cameras."""

    exposure_s: Positive = 0.01
    """s; a tenth of a millimetre of blur at 10 mm/s"""
    white_dn: Annotated[float, Field(gt=0, le=1000)] = 65.0
    """of 255, brightness of the target's white on the whole: the paper's rig is as dark as that"""
    gain: Positive = 1.0
    """linear; 1 fills the range with the sensor's saturation charge"""


class FrameShooting(Shooting):
    """Exposure, light and rendering of a sweep's frames."""

    light: Literal["room", "projector"] = "room"
    """room: some lamps, drawn by the seed; projector: the projector, fully on, in the dark"""
    quality: FilmQuality = FilmQuality()
    """rays, powers of two; more are smoother and slower"""
