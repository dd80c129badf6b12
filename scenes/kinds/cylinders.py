"""Two cylinders, one within the other, lying on the table: light measures the outer one, ultrasound the inner one."""

import numpy as np
from pydantic import model_validator

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from recon.model.rig import Finite, Fraction, Part, Positive
from scenes import solid_meshes
from scenes.noise import Seed
from scenes.scene_types import Material, Scene, Thing
from scenes.table import table

MADE_OF = {"": "gel", "outer": "gelatin", "inner": "polymer", "table": "wood"}  # for ultrasound; see `scenes.acoustics`


class Config(Part):
    """The cylinders of Meza et al. 2021, section 3."""

    outer_diameter_mm: Positive = 60.0
    inner_diameter_mm: Positive = 15.82
    wall_mm: Positive = 22.38  # from the outer to the inner wall, on the upper side, which faces the camera
    length_mm: Positive = 160.0
    middle_mm: tuple[Finite, Finite] = (4.0, -2.0)  # x, y of the middle of the outer axis
    table_mm: Positive = 700.0  # z of the table's top, on which the outer cylinder lies
    reflectance: Fraction = 0.6
    seed: Seed = 1  # of the table's grain

    @model_validator(mode="after")
    def _within(self) -> "Config":
        room = self.outer_diameter_mm - self.inner_diameter_mm
        if self.wall_mm >= room:
            raise ValueError(f"wall_mm: expected less than {room:g} to keep the inner cylinder inside, found {self.wall_mm:g}")
        return self


def build(config: Config) -> Scene:
    """Outer and inner cylinder along x, and the table. The inner one is offset in depth so that the wall is right."""
    outer_radius, inner_radius = config.outer_diameter_mm / 2, config.inner_diameter_mm / 2
    top = config.table_mm - config.outer_diameter_mm
    x, y = config.middle_mm
    outer_centre = np.array([x, y, top + outer_radius])
    inner_centre = np.array([x, y, top + config.wall_mm + inner_radius])
    axis = np.array([1.0, 0.0, 0.0])

    outer = solid_meshes.moved(solid_meshes.rod(outer_radius, config.length_mm), rigid.transform(np.eye(3), outer_centre))
    inner = solid_meshes.moved(solid_meshes.rod(inner_radius, 0.9 * config.length_mm), rigid.transform(np.eye(3), inner_centre))
    material = Material(config.reflectance)
    things = (Thing("outer", outer, material), Thing("inner", inner, material, inside=True), table(config.table_mm, config.seed))
    shapes = (Cylinder("outer", outer_centre, axis, outer_radius), Cylinder("inner", inner_centre, axis, inner_radius))
    return Scene("cylinders", things, shapes)
