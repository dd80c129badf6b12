"""Bodies that stand beside a scene, such as a patient's board on its post, as things of the scene: so fringes fall on them."""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import Target
from scenes import solid_meshes
from scenes.handheld import lofts
from scenes.handheld.body_look import Stand
from scenes.handheld.mesh_parts import Part
from scenes.scene_types import Material, Thing

Array = NDArray[np.float64]

INK_MM = 0.005  # by which ink stands off the paper
SIDES = 256  # of a circle
REFLECTANCES = {"board": 0.4, "bracket": 0.25, "metal": 0.3}  # of painted or anodised parts, in the green
OTHER = 0.4


def stand_at(pose: Array, target: Target, meshes: Sequence[trimesh.Trimesh], eyes: Array, about: Array, moved: Array) -> Stand:
    """Where a body stands on meshes that lie with their backs along z, and have moved since.

    Parameters
    ----------
    pose : (4, 4) world_from_target, mm
    eyes : (n, 3) mm, in the target's frame
    about : (3,) mm in the world, from which an arm leads away
    moved : (4, 4) from where the meshes are to the world
    """
    into, middle = rigid.invert(pose), rigid.apply(pose, circle_layout.middle(target))
    up = rigid.rotate(moved, np.array([0.0, 0.0, -1.0]))
    outwards = middle - about
    outwards = outwards - (outwards @ up) * up
    away = outwards / max(float(np.linalg.norm(outwards)), 1e-9)
    height = height_over(meshes, rigid.apply(rigid.invert(moved), middle))
    return Stand(eyes, rigid.rotate(into, up), height, rigid.rotate(into, away))


def height_over(meshes: Sequence[trimesh.Trimesh], place: Array) -> float:
    """Height of a place : (3,) mm over the first surface behind it along z; 0 if there is none."""
    heights = []
    for mesh in meshes:
        a, b, c = (mesh.triangles[:, k] - place for k in range(3))
        shares = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b))], axis=1)
        under = ((shares >= 0).all(axis=1) | (shares <= 0).all(axis=1)) & (np.abs(shares.sum(axis=1)) > 0)
        depths = np.stack([a, b, c], axis=1)[under, :, 2]
        behind = (shares[under] * depths).sum(axis=1) / shares[under].sum(axis=1)
        heights += behind[behind > 0].tolist()
    return min(heights, default=0.0)


def things(name: str, target: Target, parts: Sequence[Part], pose: Array, ink: float, paper: float) -> list[Thing]:
    """A body's parts, of which the first is its print, and its rings; named after it.

    Parameters
    ----------
    pose : (4, 4) world_from_target, mm
    ink, paper : diffuse reflectances of the print
    """
    board, *others = parts
    low, high = board.mesh.bounds
    sheet_mm = 0.04
    sheet = lofts.box([*(high - low)[:2], sheet_mm], (low + high) / 2 - [0, 0, sheet_mm / 2])
    made = [Thing(f"{name} paper", solid_meshes.moved(sheet, pose), Material(paper), smooth=False)]
    for number, centre in enumerate(circle_layout.circle_centres(target)):
        ring = trimesh.creation.annulus(
            target.inner_diameter_mm / 2, target.outer_diameter_mm / 2, height=2 * INK_MM, sections=SIDES
        )
        placed = pose @ rigid.transform(np.eye(3), centre)
        made.append(Thing(f"{name} c{number}", solid_meshes.moved(ring, placed), Material(ink), smooth=False))
    for number, part in enumerate(others):
        mesh = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, process=False)
        material = Material(REFLECTANCES.get(part.slot, OTHER))
        made.append(
            Thing(f"{name} {part.slot} {number}", solid_meshes.moved(mesh, pose), material, part.albedo, smooth=part.smooth)
        )
    return made
