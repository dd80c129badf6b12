"""A sphere of known radius, before an optional background plane."""

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from recon.geometry import rigid
from recon.geometry.primitives import Shape, Sphere
from recon.model.rig import Fraction, Part, Positive, Vector
from scenes import solid_meshes
from scenes.kinds import plane
from scenes.scene_types import Material, Scene, Thing

MADE_OF = {"": "water", "sphere": "sanded", "background": "polymer"}  # for ultrasound, in a tank; see `scenes.acoustics`


class Config(Part):
    """A sphere by its place, size and paint."""

    radius_mm: Annotated[float, Field(gt=0, le=150)] = 19.8  # Meza et al. 2021
    centre_mm: Vector = (4.0, -2.0, 650.0)
    background_mm: Positive | None = 710.0  # z of the plane behind it; None for nothing behind
    reflectance: Fraction = 0.6
    background_reflectance: Fraction = 0.3

    @model_validator(mode="after")
    def _apart(self) -> "Config":
        back = self.centre_mm[2] + self.radius_mm
        if self.background_mm is not None and self.background_mm < back:
            raise ValueError(f"background_mm: expected at least {back:g}, behind the sphere, found {self.background_mm:g}")
        return self


def build(config: Config) -> Scene:
    """The sphere, with its exact shape for a renderer that has spheres, and the background."""
    centre = np.array(config.centre_mm)
    sphere = Sphere("sphere", centre, config.radius_mm)
    mesh = solid_meshes.moved(solid_meshes.ball(config.radius_mm), rigid.transform(np.eye(3), centre))
    things = [Thing("sphere", mesh, Material(config.reflectance), primitive=sphere)]
    shapes: list[Shape] = [sphere]
    if config.background_mm is not None:
        background, front = plane.behind(centre[0], centre[1], config.background_mm, config.background_reflectance)
        things.append(background)
        shapes.append(front)
    return Scene("sphere", tuple(things), tuple(shapes))
