"""Two crossed wires in a water tank, for calibration of the probe (Meza et al. 2021, section 2.3)."""

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from recon.model.rig import Finite, Fraction, Part, Positive, Vector
from scenes import solid_meshes
from scenes.kinds.tank import bottom
from scenes.scene_types import Material, Scene, Thing

MADE_OF = {"": "water", "wire": "nylon", "tank": "polymer"}  # for ultrasound; see `scenes.acoustics`


class Config(Part):
    """Nylon line crossed at a right angle. The paper gives no diameters; 0.2 mm is an ordinary fishing line."""

    cross_mm: Vector = (4.0, -2.0, 660.0)  # where the wires touch, in the world
    angle_deg: Annotated[float, Field(ge=5, le=175)] = 90.0  # between the wires
    turn_deg: Finite = 0.0  # of their bisector from x, about the line of sight
    diameter_mm: Annotated[float, Field(ge=0.02, le=0.9)] = 0.2
    length_mm: Positive = 120.0
    bottom_mm: Positive = 740.0  # z of the tank's bottom
    reflectance: Fraction = 0.6


def build(config: Config) -> Scene:
    """Two wires that touch, one above the other, and the tank's bottom. `cross_mm` is the midpoint between their axes."""
    things, shapes = [], []
    for k, side in enumerate((-0.5, 0.5)):
        turn = Rotation.from_euler("z", config.turn_deg + side * config.angle_deg, degrees=True).as_matrix()
        centre = np.array(config.cross_mm) + np.array([0, 0, side * config.diameter_mm])
        mesh = solid_meshes.moved(solid_meshes.rod(config.diameter_mm / 2, config.length_mm), rigid.transform(turn, centre))
        things.append(Thing(f"wire{k}", mesh, Material(config.reflectance)))
        shapes.append(Cylinder(f"wire{k}", centre, turn[:, 0], config.diameter_mm / 2))
    x, y, _ = config.cross_mm
    return Scene("crosswire", (*things, bottom(config.bottom_mm, (x, y), (200.0, 150.0), 0.3)), tuple(shapes))
