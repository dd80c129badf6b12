"""Colours of what a scene holds, the same wherever it is shown."""

from dataclasses import dataclass
from typing import Generic, TypeVar

Colour = TypeVar("Colour")


@dataclass(frozen=True)
class Palette(Generic[Colour]):
    """A colour for each kind of thing."""

    skin: Colour
    table: Colour
    mass: Colour
    path: Colour  # of the probe
    device: Colour
    body: Colour  # of the probe and its target
    ink: Colour  # of the target's circles
    unseen: Colour  # places that are still to be scanned


IN_SPACE = Palette(  # red, green, blue and opacity, 0 to 255: of models on dark ground
    skin=(224, 187, 165, 150),
    table=(120, 105, 90, 255),
    mass=(200, 60, 60, 255),
    path=(60, 140, 220, 255),
    device=(90, 90, 90, 255),
    body=(235, 235, 235, 255),
    ink=(20, 20, 20, 255),
    unseen=(240, 180, 60, 70),
)
ON_PAGE = Palette(  # lighter, of a page's white ground
    skin="#f2e0d2",
    table="#c9bfb2",
    mass="#c8553d",
    path="#3c8cdc",
    device="#5a5a5a",
    body="#d8d8d4",
    ink="#202020",
    unseen="#e0a030",
)
