"""The inner cylinder alone in a water tank, as ultrasound measured it (Meza et al. 2021, section 3: 94 slices, 15.82 mm)."""

import numpy as np

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from recon.model.rig import Fraction, Part, Positive, Vector
from scenes import solid_meshes
from scenes.kinds.tank import bottom
from scenes.scene_types import Material, Scene, Thing

MADE_OF = {"": "water", "inner": "polymer", "tank": "polymer"}  # for ultrasound; see `scenes.acoustics`


class Config(Part):
    """A cylinder along x under water."""

    diameter_mm: Positive = 15.82
    length_mm: Positive = 120.0
    centre_mm: Vector = (4.0, -2.0, 670.0)  # middle of the axis, in the world
    bottom_mm: Positive = 740.0  # z of the tank's bottom
    reflectance: Fraction = 0.6


def build(config: Config) -> Scene:
    """Cylinder and bottom."""
    centre, radius = np.array(config.centre_mm), config.diameter_mm / 2
    rod = solid_meshes.moved(solid_meshes.rod(radius, config.length_mm), rigid.transform(np.eye(3), centre))
    things = (
        Thing("inner", rod, Material(config.reflectance)),
        bottom(config.bottom_mm, (float(centre[0]), float(centre[1])), (200.0, 150.0), 0.3),
    )
    return Scene("inner_cylinder", things, (Cylinder("inner", centre, np.array([1.0, 0.0, 0.0]), radius),))
