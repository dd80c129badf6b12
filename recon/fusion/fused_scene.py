"""Skin by light and B-scans, masses and the probe's path by ultrasound, with the devices, as layers of one scene in the world."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.files import meshes
from recon.files.meshes import painted, pictured
from recon.freehand.scans import Scans
from recon.fusion import probe_shape
from recon.fusion.palette import IN_SPACE
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.rig import Target
from recon.segmentation.left_out import LeftOut
from recon.segmentation.mass_files import FoundMass
from recon.segmentation.seen_map import SeenFiles

Array = NDArray[np.float64]

GREY_SKIN, GREY_TABLE = (255, 240, 230, 170), (255, 255, 255, 255)  # over which the surface's own grey is laid
STEP_MM = 1.0  # of the surfaces' vertices, which are merged to that


@dataclass(frozen=True, eq=False)
class FusedScene:
    """All that was measured, in the frame of camera 1."""

    images: Mapping[int, NDArray[np.uint8]]  # some B-scans (h, w) by their numbers
    scans: Scans
    world_from_target: Array  # (n, 4, 4) at the B-scans; NaN without a pose
    target: Target
    skin: trimesh.Trimesh | None = None
    rest: trimesh.Trimesh | None = None  # table and background
    masses: Mapping[str, FoundMass] | None = None  # None where none were looked for, or the search failed
    devices: Mapping[str, Camera] = field(default_factory=dict)
    search_failed: str = ""  # why the search for masses failed
    left_out: Sequence[LeftOut] = ()  # by that search, where a mass may be missing
    seen: SeenFiles | None = None  # the map of where masses would have been found

    @property
    def search(self) -> str:
        """Outcome of the search for masses, as a sentence."""
        if self.search_failed:
            return f"The search for masses failed, so there may be some ({self.search_failed})."
        if self.masses is None:
            return "Masses were not looked for."
        count = len(self.masses)
        return f"Masses were looked for: {count or 'none'} {'was' if count < 2 else 'were'} found."

    @property
    def middle(self) -> int | None:
        """Number of the B-scan in the middle of those with images; None without."""
        numbers = list(self.images)
        return numbers[len(numbers) // 2] if numbers else None

    @property
    def path(self) -> Array:
        """Pieces : (m, 2, 3) mm of the way of the array's face, its middle, between B-scans in a row that both have a pose.

        Where the probe rests there is no piece.
        """
        face_row = 0.0 if self.scans.probe is None else self.scans.probe.face_row
        middles = _faces_middle(self.scans.world_from_pixel, self.scans.shape[1], face_row)
        pieces = np.stack([middles[:-1], middles[1:]], axis=1)
        return pieces[np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1) > 1e-6]  # not so of NaN


def layers(scene: FusedScene, scans: int) -> dict[str, trimesh.Trimesh]:
    """All of a scene, by the layers' names, with so many of its B-scans."""
    made = {}
    if scene.skin is not None:
        made["skin"] = surface_layer(scene.skin, IN_SPACE.skin, GREY_SKIN)
    if scene.rest is not None:
        made["table"] = surface_layer(scene.rest, IN_SPACE.table, GREY_TABLE)
    made |= {name: painted(mass.mesh, IN_SPACE.mass) for name, mass in (scene.masses or {}).items()}
    if scene.seen is not None and scene.seen.unseen is not None:
        made["unseen"] = painted(scene.seen.unseen, IN_SPACE.unseen)
    for k in evenly(list(scene.images), scans):
        made[f"scan{k:04d}"] = scan_layer(scene.images[k], scene.scans.world_from_pixel[k])
    if len(scene.path):
        made["path"] = path_layer(scene.path)
    if scene.middle is not None and scene.scans.probe is not None:
        body, rings = probe_shape.of(scene.target, scene.scans.probe, scene.scans.shape[1])
        for name, mesh, colour in (("probe", body, IN_SPACE.body), ("circles", rings, IN_SPACE.ink)):
            made[name] = painted(mesh.copy().apply_transform(scene.world_from_target[scene.middle]), colour)
    return made | {name: device_layer(camera) for name, camera in scene.devices.items()}


def surface_layer(
    mesh: trimesh.Trimesh, plain: tuple[int, int, int, int], over_grey: tuple[int, int, int, int]
) -> trimesh.Trimesh:
    """A measured surface, coarser, in a colour: in its own grey under another colour, where it has one."""
    coarse = merged(mesh, STEP_MM)
    greys = meshes.greys_of(coarse)
    return painted(coarse, plain) if greys is None else painted(coarse, over_grey, greys)


def scan_layer(image: NDArray[np.uint8], world_from_pixel: Array) -> trimesh.Trimesh:
    """A B-scan : (h, w) where it was taken, to the borders of its outer pixels."""
    return pictured(_scan_corners(image.shape[1], image.shape[0], world_from_pixel), image)


def _scan_corners(width: int, height: int, world_from_pixel: Array) -> Array:
    """Outer corners : (4, 3) mm of a B-scan, from the upper left one on clockwise."""
    u, v = np.array([-0.5, width - 0.5, width - 0.5, -0.5]), np.array([-0.5, -0.5, height - 0.5, height - 0.5])
    return rigid.apply(world_from_pixel, np.column_stack([u, v, np.zeros(4)]))


def path_layer(ends: Array) -> trimesh.Trimesh:
    """A tube along pieces between ends : (n, 2, 3) mm, n >= 1, that don't coincide."""
    path_mm = 0.6  # radius of the path's tube
    pieces = [trimesh.creation.cylinder(path_mm, segment=both, sections=6) for both in ends]
    whole = trimesh.util.concatenate(pieces)
    assert isinstance(whole, trimesh.Trimesh)
    return painted(whole, IN_SPACE.path)


def device_layer(camera: Camera) -> trimesh.Trimesh:
    """A camera or the projector as a pyramid: its centre, and its view some centimetres away."""
    width, height = camera.size
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)
    device_mm = 40.0  # length of a device's pyramid
    vertices = np.vstack([camera.centre, camera.centre + device_mm * camera.rays(corners)])
    faces = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]
    return painted(trimesh.Trimesh(vertices, faces, process=False), IN_SPACE.device)


def merged(mesh: trimesh.Trimesh, step_mm: float) -> trimesh.Trimesh:
    """A mesh whose vertices in the same cell of a grid are merged to their mean, in place and grey, for pictures."""
    vertices, greys = np.asarray(mesh.vertices, float), meshes.greys_of(mesh)
    grid = np.floor(vertices / step_mm).astype(np.int64)
    grid -= grid.min(axis=0)
    number = np.ravel_multi_index(tuple(grid.T), tuple((grid.max(axis=0) + 1).tolist()))
    _, cell, count = np.unique(number, return_inverse=True, return_counts=True)
    means = np.column_stack([np.bincount(cell, vertices[:, axis]) for axis in range(3)]) / count[:, None]
    faces = cell[np.asarray(mesh.faces)]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    a, b, c = np.sort(faces, axis=1).T
    _, first = np.unique((a * len(count) + b) * len(count) + c, return_index=True)
    result = trimesh.Trimesh(means, faces[np.sort(first)], process=False)
    if greys is not None:
        meshes.set_greys(result, np.uint8(np.rint(np.bincount(cell, greys) / count)))
    return result


def chosen(placed: NDArray[np.bool_], count: int) -> list[int]:
    """Numbers of `count` B-scans with a pose, evenly through the sweep."""
    return evenly(np.flatnonzero(placed).tolist(), count)


def evenly(numbers: list[int], count: int) -> list[int]:
    """At most `count` of some numbers, evenly."""
    return (
        [numbers[k] for k in np.linspace(0, len(numbers) - 1, min(count, len(numbers))).astype(int).tolist()] if numbers else []
    )


def _faces_middle(world_from_pixel: Array, width: int, face_row: float) -> Array:
    """Middles of the array's face : (n, 3) mm, from matrices : (n, 4, 4) of B-scans as wide as some px; NaN without a pose."""
    there = world_from_pixel[:, :3, 0] * (width - 1) / 2 + world_from_pixel[:, :3, 3]
    return there + world_from_pixel[:, :3, 1] * face_row if face_row else there
