"""Separate objects with deep steps and shadows, to strain spatial unwrapping.

A box and a lower block stand before a plate, and a sphere floats beside it with nothing behind. The projector stands to the
left, so the box throws a shadow to its right: the strip of plate beyond is joined to the centre line only around the box,
and the sphere isn't joined to it at all.
"""

from typing import Annotated

import numpy as np
from pydantic import Field

from recon.geometry import rigid
from recon.geometry.primitives import Plane, Sphere
from recon.model.rig import Fraction, Part, Positive
from scenes import solid_meshes
from scenes.scene_types import Material, Scene, Thing

Step = Annotated[float, Field(ge=5, le=80)]

TOWARDS_CAMERA = np.array([0.0, 0.0, -1.0])
GAP_MM = 8.0  # between plate and box: the box's shadow falls on the plate with nothing to lead unwrapping across
SPHERE = (93.0, -12.0)  # middle in x, y, mm; right of the plate, off the centre column


class Config(Part):
    """The objects by their depths; their places across the view are fixed."""

    plate_mm: Positive = 705.0  # z of the plate's front
    box_step_mm: Annotated[float, Field(gt=GAP_MM, le=90)] = 55.0  # from the plate's front to the box's
    block_step_mm: Step = 25.0  # from the plate's front to the block's, which stands on the plate
    sphere_step_mm: Step = 50.0  # from the plate's front to the sphere's middle
    sphere_radius_mm: Annotated[float, Field(ge=5, le=24)] = 22.0  # leaves a gap beside the plate
    reflectance: Fraction = 0.6


def build(config: Config) -> Scene:
    """Plate, box, block and sphere, with the planes of the three fronts and the sphere."""
    box_z, block_z = config.plate_mm - config.box_step_mm, config.plate_mm - config.block_step_mm
    centre = np.array([*SPHERE, config.plate_mm - config.sphere_step_mm])
    plate = ((-25.0, 0.0), (170.0, 180.0))  # middle and size in x, y, mm; crosses the projector's centre column, near x = 0
    box = ((-5.0, -4.0), (60.0, 90.0))
    block = ((-82.0, 20.0), (34.0, 80.0))
    fronts = (
        ("plate", plate, config.plate_mm, 5.0),
        ("box", box, box_z, config.box_step_mm - GAP_MM),
        ("block", block, block_z, config.block_step_mm),
    )
    sphere = Sphere("sphere", centre, config.sphere_radius_mm)
    ball = solid_meshes.moved(solid_meshes.ball(config.sphere_radius_mm), rigid.transform(np.eye(3), centre))
    material = Material(config.reflectance)
    things = [Thing("sphere", ball, material, primitive=sphere)]
    planes = []
    for name, ((x, y), size), z, thickness in fronts:
        place = rigid.transform(np.eye(3), (x, y, z))
        things.append(Thing(name, solid_meshes.moved(solid_meshes.plate(size, thickness), place), material, smooth=False))
        planes.append(Plane(name, place[:3, 3], TOWARDS_CAMERA))
    return Scene("two_objects", tuple(things), (*planes, sphere))
