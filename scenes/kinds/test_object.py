"""A test object of tissue-mimicking gelatin: rows of filaments as point targets, cysts, brighter and darker inclusions."""

import numpy as np

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from recon.model.rig import Finite, Fraction, Part, Positive
from scenes import solid_meshes
from scenes.scene_types import Material, Scene, Thing

MADE_OF = {
    "": "gel",
    "block": "gelatin",
    "wire": "nylon",
    "cyst": "cyst",
    "bright": "bright",
    "dark": "dark",
}  # for ultrasound; see `scenes.acoustics`


class Config(Part):
    """All targets run along y, so that a section of constant y shows them as points and discs."""

    top_mm: Positive = 650.0  # z of the block's upper face
    middle_mm: tuple[Finite, Finite] = (4.0, -2.0)  # x, y of the block's middle
    size_mm: tuple[Positive, Positive, Positive] = (80.0, 80.0, 60.0)
    filament_mm: Positive = 0.1  # diameter
    filament_x_mm: Finite = -12.0  # of the column of filaments, from the middle
    filament_depths_mm: tuple[Positive, ...] = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
    row_depth_mm: Positive = 30.0  # of a row of filaments
    row_x_mm: tuple[Finite, ...] = (-7.0, -5.0, -4.0, -3.5)
    filaments_mm: tuple[tuple[Finite, Positive], ...] | None = (
        None  # x from the middle, depth; in place of the column and the row
    )
    cysts: tuple[tuple[Finite, Positive, Positive], ...] = (
        (2.0, 12.0, 5.0),
        (2.0, 25.0, 7.0),
        (2.0, 40.0, 8.0),
    )  # x, depth, size
    bright: tuple[tuple[Finite, Positive, Positive], ...] = ((13.0, 16.0, 7.0),)
    dark: tuple[tuple[Finite, Positive, Positive], ...] = ((13.0, 33.0, 8.0),)
    reflectance: Fraction = 0.4


def build(config: Config) -> Scene:
    """The block, and its targets inside."""
    x, y = config.middle_mm
    length, width, height = config.size_mm
    pose = rigid.transform(np.eye(3), (x, y, config.top_mm))
    block = Thing(
        "block", solid_meshes.moved(solid_meshes.plate((length, width), height), pose), Material(config.reflectance), smooth=False
    )
    places = [(config.filament_x_mm, depth) for depth in config.filament_depths_mm]
    places += [(across, config.row_depth_mm) for across in config.row_x_mm]
    places = places if config.filaments_mm is None else list(config.filaments_mm)
    targets = [(f"wire{k}", across, depth, config.filament_mm) for k, (across, depth) in enumerate(places)]
    for name, discs in (("cyst", config.cysts), ("bright", config.bright), ("dark", config.dark)):
        targets += [(f"{name}{k}", *disc) for k, disc in enumerate(discs)]
    things, shapes = [block], []
    for name, across, depth, size in targets:
        centre = np.array([x + across, y, config.top_mm + depth])
        along_y = rigid.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], centre)
        rod = solid_meshes.moved(solid_meshes.rod(size / 2, width - 2), along_y)
        things.append(Thing(name, rod, Material(config.reflectance), inside=True))
        shapes.append(Cylinder(name, centre, np.array([0.0, 1.0, 0.0]), size / 2))
    return Scene("test_object", tuple(things), tuple(shapes))
