"""A water tank with a flat bottom, for the lag between scanner and cameras and for the scale in depth."""

import numpy as np

from recon.geometry import rigid
from recon.geometry.primitives import Plane
from recon.model.rig import Finite, Fraction, Part, Positive
from scenes import solid_meshes
from scenes.scene_types import Material, Scene, Thing

MADE_OF = {"": "water", "tank": "polymer"}  # for ultrasound; see `scenes.acoustics`


class Config(Part):
    """A flat plate under water; the water's surface is left out, for no instrument of the twin looks through it."""

    bottom_mm: Positive = 700.0  # z of the bottom
    middle_mm: tuple[Finite, Finite] = (4.0, -2.0)  # x, y
    size_mm: tuple[Positive, Positive] = (200.0, 150.0)
    reflectance: Fraction = 0.3


def build(config: Config) -> Scene:
    """The bottom alone."""
    shape = Plane("tank", np.array([*config.middle_mm, config.bottom_mm]), np.array([0.0, 0.0, -1.0]))
    return Scene("tank", (bottom(config.bottom_mm, config.middle_mm, config.size_mm, config.reflectance),), (shape,))


def bottom(depth_mm: float, middle_mm: tuple[float, float], size_mm: tuple[float, float], reflectance: float) -> Thing:
    """A tank's bottom: a plate whose upper face lies at z = depth_mm."""
    thickness_mm = 10.0
    plate = solid_meshes.moved(solid_meshes.plate(size_mm, thickness_mm), rigid.transform(np.eye(3), (*middle_mm, depth_mm)))
    return Thing("tank", plate, Material(reflectance), smooth=False)
