"""Closed surfaces of masses: signed distances to them, and surfaces without folds from these."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree
from skimage.measure import marching_cubes
from skimage.morphology import local_maxima, reconstruction
from skimage.segmentation import watershed

from recon import threads
from recon.files.volumes import Volume
from recon.freehand.volume_compounding import Grid, grid_over
from recon.geometry import rigid
from recon.geometry.surface_tree import nearest

Array = NDArray[np.float64]

NEAR_MM = 1.5  # of a vertex, within which distances come from the surface itself
FAR_MM = 5.0  # around a mass, to which distances reach


@dataclass(frozen=True)
class Mass:
    """A mass in the world."""

    mesh: trimesh.Trimesh  # closed, mm
    bright: bool = False  # whether it echoes more than the tissue around
    beside: bool = False  # whether it touches another one, from which it was parted at the waist of both: perhaps they are one

    @property
    def volume(self) -> float:
        """mm^3."""
        return float(self.mesh.volume)

    @property
    def centre(self) -> Array:
        """Centre of gravity : (3,) mm."""
        return np.asarray(self.mesh.center_mass)


def evened(mass: Mass, axes: Array) -> Mass:
    """The same mass without folds and spikes finer than 0.5 mm, of the same volume.

    Moved vertices can cross each other; the smoothed distance to them has a clean surface, taken at the level of the same volume.
    Its vertices are 0.5 mm apart along the axes : (3, 3), columns.
    """
    even_mm = 0.5  # standard deviation; lobes of the blurred borders are wider
    mesh_mm = 0.5  # between vertices
    near = distances([mass], grid_over(mass.mesh.vertices, axes, np.full(3, mesh_mm), NEAR_MM + 3 * even_mm))
    field, whole = ndimage.gaussian_filter(near.voxels, even_mm / mesh_mm), 3 * (slice(0, None),)
    level, volume = 0.0, _enclosed(np.asarray(mass.mesh.vertices), mass.mesh.faces).sum()
    levellings = 4  # Newton's steps to the level that holds the volume
    for _ in range(levellings):
        mesh = meshed(field, level, whole, near, outside=FAR_MM)
        level += (volume - _enclosed(np.asarray(mesh.vertices), mesh.faces).sum()) / mesh.area
    return replace(mass, mesh=meshed(field, level, whole, near, outside=FAR_MM))


def parted(mass: Mass, axes: Array) -> list[Mass]:
    """The bodies of a mass that meet in a waist, largest first, or the mass itself.

    Two bodies are those with middles of their own: places that lie deeper below the surface, by `waist_mm` or more, than all ways
    from one to the other, and whose waist is narrower than the thinner one by `narrower`. Masses of one form, be it lobulated or
    spiculated, have no such waist.
    """
    waist_mm, narrower, least_mm3 = 0.6, 0.85, 50.0
    mesh_mm = max(0.3, float(np.max(mass.mesh.extents)) / 100)
    near = distances([mass], grid_over(mass.mesh.vertices, axes, np.full(3, mesh_mm), NEAR_MM))
    inside = near.voxels < 0
    deep = np.asarray(ndimage.distance_transform_edt(inside)) * mesh_mm
    middles, count = ndimage.label(local_maxima(reconstruction(np.maximum(deep - waist_mm, 0), deep)))
    while count > 1:
        bodies, numbers = watershed(-deep, middles, mask=inside), range(1, count + 1)
        waists = np.array(
            [deep[ndimage.binary_dilation(bodies == k) & (bodies > 0) & (bodies != k)].max(initial=0) for k in numbers]
        )
        volumes = np.bincount(bodies.ravel(), minlength=count + 1)[1:] * mesh_mm**3
        one = (waists > narrower * ndimage.maximum(deep, bodies, numbers)) | (volumes < least_mm3)
        if not one.any():
            whole = 3 * (slice(0, None),)
            fields = (np.where((bodies == 0) | (bodies == k), near.voxels, mesh_mm / 2) for k in numbers)
            parts = [replace(mass, mesh=meshed(field, 0.0, whole, near, outside=FAR_MM), beside=True) for field in fields]
            return sorted(parts, key=lambda part: -part.volume)
        middles[middles == 1 + np.where(one, volumes, np.inf).argmin()] = 0  # the smallest goes to its neighbour
        middles, count = ndimage.label(middles > 0)
    return [mass]


def _around(mass: Mass, lattice: Volume) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First voxel and the one after the last : (3,) x, y, z, of the box `FAR_MM` around a mass, maybe beyond the lattice."""
    voxel = rigid.apply(np.linalg.inv(lattice.world_from_voxel), mass.mesh.vertices)
    margin = FAR_MM / lattice.spacing
    return np.floor(voxel.min(axis=0) - margin).astype(int), np.ceil(voxel.max(axis=0) + margin).astype(int) + 1


def distances(masses: Sequence[Mass], grid: Grid) -> Volume:
    """Signed distance to the masses : mm, negative inside, on a grid; `FAR_MM` at most, and exact near them only."""
    field = np.full(grid.size[::-1], FAR_MM, np.float32)
    volume = Volume(field, grid.origin, grid.spacing, grid.directions)
    for mass in masses:
        low, high = _around(mass, volume)
        part = tuple(slice(max(a, 0), min(b, n)) for a, b, n in zip(low[::-1], high[::-1], field.shape, strict=True))
        near = _near_distance(mass.mesh, volume, part)
        apart, _ = ndimage.label(np.isnan(near))
        bodies, count = ndimage.label((apart != apart[0, 0, 0]) & ~(near >= 0))
        inside = bodies == np.bincount(bodies.ravel())[1:].argmax() + 1 if count else bodies > 0  # narrow hollows are unsure
        out, into = threads.mapped(lambda one: ndimage.distance_transform_edt(one, grid.spacing[::-1]), (~inside, inside))
        whole = np.asarray(out) - np.asarray(into) - np.where(inside, -0.5, 0.5) * grid.spacing.min()
        signed = np.where(np.isfinite(near) & ((near < 0) == inside), near, whole)
        field[part] = np.minimum(field[part], np.clip(signed, -FAR_MM, FAR_MM))
    return volume


def _near_distance(mesh: trimesh.Trimesh, volume: Volume, part: tuple[slice, ...]) -> NDArray:
    """Signed distance of a part's voxels to a mesh, by the tangent planes of its nearest vertices; NaN beyond `NEAR_MM`."""
    shape, low = tuple(s.stop - s.start for s in part), [s.start for s in part[::-1]]
    voxel = np.rint(rigid.apply(np.linalg.inv(volume.world_from_voxel), mesh.vertices)).astype(int) - low
    apart = np.ones(shape, bool)
    apart[tuple(np.clip(voxel, 0, np.array(shape[::-1]) - 1).T[::-1])] = False
    k, j, i = np.nonzero(np.asarray(ndimage.distance_transform_edt(apart, volume.spacing[::-1])) < NEAR_MM)
    places = rigid.apply(volume.world_from_voxel, np.column_stack([i, j, k]) + low)
    neighbours = 6  # vertices that the distance to a surface is taken from
    _, chosen = nearest(KDTree(mesh.vertices), places, neighbours)
    across = ((places[:, None] - mesh.vertices[chosen]) * mesh.vertex_normals[chosen]).sum(axis=2)
    result = np.full(shape, np.nan)
    result[k, j, i] = across.mean(axis=1)
    return result


def meshed(field: NDArray, level: float, part: tuple[slice, ...], volume: Volume, outside: float = 1.0) -> trimesh.Trimesh:
    """The largest closed surface at a level of a field, given in a part of a volume and constant outside of it."""
    vertices, faces, _, _ = marching_cubes(np.pad(field, 1, constant_values=outside), level)
    index = vertices[:, ::-1] - 1 + [s.start for s in part[::-1]]
    places, faces = _largest(rigid.apply(volume.world_from_voxel, index), faces)
    outwards = faces if _enclosed(places, faces).sum() > 0 else faces[:, ::-1]
    return trimesh.Trimesh(places, outwards, process=False)


def _enclosed(vertices: Array, faces: NDArray[np.int32]) -> Array:
    """Signed volumes : (m,) mm^3 of the tetrahedra of triangles and the vertices' mean; they add up to a closed surface's."""
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    return (a * np.cross(b, c)).sum(axis=1) / 6


def _largest(vertices: Array, faces: NDArray[np.int32]) -> tuple[Array, NDArray[np.int32]]:
    """Vertices and faces of the connected surface with the greatest volume."""
    ends = np.hstack([faces[:, :2].T, faces[:, 1:].T])
    joined = sparse.coo_matrix((np.ones(ends.shape[1], bool), ends), shape=2 * (len(vertices),))
    count, label = csgraph.connected_components(joined, directed=False)
    if count == 1:
        return vertices, faces
    volumes = np.bincount(label[faces[:, 0]], _enclosed(vertices, faces), count)
    chosen = label == np.abs(volumes).argmax()
    number = np.cumsum(chosen) - 1
    return vertices[chosen], number[faces[chosen[faces[:, 0]]]]
