"""A flat plate: the simplest thing that measures noise, flatness and calibration."""

import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.primitives import Plane
from recon.model.rig import Finite, Fraction, Part, Positive, Vector
from scenes import solid_meshes
from scenes.scene_types import Material, Scene, Thing

MADE_OF = {"": "water", "plate": "sanded"}  # for ultrasound, a wall in a tank; see `scenes.acoustics`
THICKNESS_MM = 5.0


class Config(Part):
    """A plate by its pose, size and paint."""

    centre_mm: Vector = (4.0, -2.0, 660.0)  # middle of the front face
    tilt_deg: tuple[Finite, Finite] = (0.0, 0.0)  # about x, then about y, through the middle
    size_mm: tuple[Positive, Positive] = (320.0, 260.0)  # width, height
    reflectance: Fraction = 0.6


# The five planes of Meza et al. 2021, section 3: a volume of 253 x 199 x 107 mm, 606 to 713 mm from camera 1. The paper gives
# the volume, not the poses; these fill the view of camera 1 and span that depth.
PAPER_POSES = (
    Config(centre_mm=(4.0, -2.0, 622.0), tilt_deg=(-3.0, 4.0)),
    Config(centre_mm=(4.0, -2.0, 641.0), tilt_deg=(5.0, -8.0)),
    Config(centre_mm=(4.0, -2.0, 660.0), tilt_deg=(3.0, 12.0)),
    Config(centre_mm=(4.0, -2.0, 679.0), tilt_deg=(-6.0, -8.0)),
    Config(centre_mm=(4.0, -2.0, 698.0), tilt_deg=(3.0, -4.0)),
)


def build(config: Config) -> Scene:
    """The plate and its plane."""
    world_from_plate = tilted(config.centre_mm, config.tilt_deg)
    mesh = solid_meshes.moved(solid_meshes.plate(config.size_mm, THICKNESS_MM), world_from_plate)
    plane = Plane("plate", world_from_plate[:3, 3], -world_from_plate[:3, 2])
    return Scene("plane", (Thing("plate", mesh, Material(config.reflectance), smooth=False),), (plane,))


def behind(x: float, y: float, z: float, reflectance: float) -> tuple[Thing, Plane]:
    """A background : a plate of the usual size that faces camera 1, the middle of its front at x, y, z mm, and its plane."""
    place = rigid.transform(np.eye(3), (x, y, z))
    background = solid_meshes.moved(solid_meshes.plate((320, 260), THICKNESS_MM), place)
    thing = Thing("background", background, Material(reflectance), smooth=False)
    return thing, Plane("background", place[:3, 3], np.array([0.0, 0.0, -1.0]))


def tilted(centre_mm: Vector, tilt_deg: tuple[float, float]) -> rigid.Array:
    """Pose `world_from_plate` : (4, 4) of a plate turned about the world's x axis, then about its y axis."""
    rotation = Rotation.from_euler("xy", np.asarray(tilt_deg), degrees=True)
    return rigid.transform(rotation.as_matrix(), centre_mm)
