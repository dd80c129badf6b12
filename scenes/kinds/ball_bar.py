"""A ball bar: two balls on a rod, whose centres stand apart by a certified length, before a background plane."""

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from recon.geometry import rigid
from recon.geometry.primitives import Shape, Sphere
from recon.model.rig import Fraction, Part, Positive, Vector
from scenes import solid_meshes
from scenes.kinds import plane
from scenes.scene_types import Material, Scene, Thing


class Config(Part):
    """The bar by its place, lengths and paint."""

    length_mm: Annotated[float, Field(gt=0, le=400)] = 150.0  # from centre to centre
    ball_mm: Annotated[float, Field(gt=0, le=100)] = 25.4  # diameter of the balls
    rod_mm: Positive = 8.0  # diameter
    middle_mm: Vector = (4.0, -2.0, 650.0)
    turn_deg: float = 20.0  # of the bar about camera 1's axis, from its x axis
    rise_deg: Annotated[float, Field(ge=-60, le=60)] = 0.0  # of its second ball away from camera 1
    background_mm: Positive | None = 710.0  # z of the plane behind it; None for nothing behind
    reflectance: Fraction = 0.6
    background_reflectance: Fraction = 0.3

    @model_validator(mode="after")
    def _apart(self) -> "Config":
        if self.length_mm <= self.ball_mm:
            raise ValueError(f"length_mm: expected more than ball_mm, {self.ball_mm:g}, found {self.length_mm:g}")
        back = self.middle_mm[2] + self.length_mm / 2 * abs(np.sin(np.deg2rad(self.rise_deg))) + self.ball_mm / 2
        if self.background_mm is not None and self.background_mm < back:
            raise ValueError(f"background_mm: expected at least {back:g}, behind the balls, found {self.background_mm:g}")
        return self


def build(config: Config) -> Scene:
    """The balls, with their exact shapes for a renderer that has spheres, the rod between them, and the background."""
    middle, turn, rise = np.array(config.middle_mm), np.deg2rad(config.turn_deg), np.deg2rad(config.rise_deg)
    aside = np.array([-np.sin(turn), np.cos(turn), 0.0])
    along = np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
    paint, things = Material(config.reflectance), []
    shapes: list[Shape] = []
    for name, side in (("first", -0.5), ("second", 0.5)):
        centre = middle + side * config.length_mm * along
        ball = Sphere(name, centre, config.ball_mm / 2)
        mesh = solid_meshes.moved(solid_meshes.ball(config.ball_mm / 2), rigid.transform(np.eye(3), centre))
        things.append(Thing(name, mesh, paint, primitive=ball))
        shapes.append(ball)
    lying = rigid.transform(np.column_stack([along, aside, np.cross(along, aside)]), middle)
    things.append(Thing("rod", solid_meshes.moved(solid_meshes.rod(config.rod_mm / 2, config.length_mm), lying), paint))
    if config.background_mm is not None:
        background, front = plane.behind(middle[0], middle[1], config.background_mm, config.background_reflectance)
        things.append(background)
        shapes.append(front)
    return Scene("ball_bar", tuple(things), tuple(shapes))
