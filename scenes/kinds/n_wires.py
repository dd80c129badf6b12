"""A phantom of N-wires in a water tank, for calibration of the probe as users of the PLUS toolkit do it."""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from recon.model.rig import Finite, Fraction, Part, Positive, Vector
from recon.probe_calibration import plus_phantom
from scenes import solid_meshes
from scenes.kinds.tank import bottom
from scenes.scene_types import Material, Scene, Thing

MADE_OF = {"": "water", "wire": "nylon", "tank": "polymer"}  # for ultrasound; see `scenes.acoustics`
UPRIGHT = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # world_from_phantom: PLUS's z is up, the cameras look down


class Config(Part):
    """The wires of a PLUS configuration, level, above each other as in use."""

    wires: Path | None = None  # null is PLUS's phantom fCal 2
    middle_mm: Vector = (4.0, -2.0, 665.0)  # of all wires, in the world
    turn_deg: Finite = 0.0  # about the line of sight
    diameter_mm: Annotated[float, Field(ge=0.02, le=0.9)] = 0.2
    bottom_mm: Positive = 740.0  # z of the tank's bottom
    reflectance: Fraction = 0.6


def build(config: Config) -> Scene:
    """All wires, and the tank's bottom; the box that holds them is left out.

    Raises
    ------
    InputError
        If the configuration defines no N-wires.
    """
    phantom = plus_phantom.FCAL if config.wires is None else plus_phantom.read(config.wires)
    turned = Rotation.from_euler("z", config.turn_deg, degrees=True).as_matrix() @ UPRIGHT
    world_from_phantom = rigid.transform(turned, config.middle_mm - turned @ phantom.wires.ends.mean(axis=(0, 1, 2)))
    things, shapes = [], []
    for k, (front, back) in enumerate(rigid.apply(world_from_phantom, phantom.wires.ends).reshape(-1, 2, 3)):
        along = back - front
        length = float(np.linalg.norm(along))
        turn = Rotation.align_vectors([along / length], [[1.0, 0, 0]])[0].as_matrix()
        centre = (front + back) / 2
        mesh = solid_meshes.moved(solid_meshes.rod(config.diameter_mm / 2, length), rigid.transform(turn, centre))
        things.append(Thing(f"wire{k}", mesh, Material(config.reflectance)))
        shapes.append(Cylinder(f"wire{k}", centre, turn[:, 0], config.diameter_mm / 2))
    x, y, _ = config.middle_mm
    return Scene("n_wires", (*things, bottom(config.bottom_mm, (x, y), (200.0, 150.0), 0.3)), tuple(shapes))
