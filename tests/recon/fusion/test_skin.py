"""Is the skin parted from the table, by a mask or by the plane that it stands on, and left alone where there is no table?"""

import numpy as np
import pytest
import trimesh

from recon.files import meshes
from recon.fusion import skin
from recon.geometry import rigid
from recon.geometry.camera import Camera
from scenes.solid_meshes import grid

DOME_MM, TABLE_MM = 45.0, 700.0


def scene(rng, tilt=0.1, dome=True):
    """A dome on a tilted table, as the camera at the origin measures it; noise of 0.05 mm."""
    points, triangles = grid((200.0, 160.0), (200, 160))
    height = np.sqrt(np.maximum(DOME_MM**2 - (points**2).sum(axis=1), 0)) * dome
    local = np.column_stack([points, -height + 0.05 * rng.standard_normal(len(points))])
    pose = rigid.from_rotation_vector([tilt, -tilt, 0], [5, -8, TABLE_MM])
    mesh = trimesh.Trimesh(rigid.apply(pose, local), triangles, process=False)
    mesh.vertex_attributes["sigma_mm"] = np.full(len(points), 0.05)
    meshes.set_greys(mesh, np.uint8(np.where(height > 0, 200, 40)))
    return mesh, height


def test_a_dome_is_parted_from_its_table(rng):
    """All of it but the last millimetres above the plane, and nothing of the table; greys and sigmas stay with their points."""
    mesh, height = scene(rng)
    parted = skin.by_plane(mesh)
    assert np.count_nonzero(height > skin.STANDS_MM + 0.3) <= len(parted.skin.vertices) <= np.count_nonzero(height > 0) * 1.05
    assert (meshes.greys_of(parted.skin) == 200).mean() > 0.98 and (meshes.greys_of(parted.rest) == 40).mean() > 0.97
    assert len(parted.skin.vertex_attributes["sigma_mm"]) == len(parted.skin.vertices)
    assert len(parted.skin.faces) + len(parted.rest.faces) == len(mesh.faces)


def test_a_second_thing_on_the_table_is_not_skin(rng):
    mesh, _ = scene(rng)
    box = trimesh.creation.box([10, 10, 20]).apply_translation([80, 60, TABLE_MM - 10])
    both = trimesh.util.concatenate([mesh, box])
    both.vertex_attributes["sigma_mm"] = np.zeros(len(both.vertices))
    assert np.asarray(skin.by_plane(both).skin.bounds)[1, 0] < 60


@pytest.mark.parametrize("kind", ["plate", "sphere"])
def test_without_a_table_all_is_skin(rng, kind):
    """A plate alone isn't parted from itself, and a round thing stands on no plane."""
    mesh = scene(rng, dome=False)[0] if kind == "plate" else trimesh.creation.icosphere(5, 20.0).apply_translation([0, 0, 650])
    parted = skin.by_plane(mesh)
    assert parted.skin is mesh and parted.rest is None


def test_a_mask_without_surface_leaves_no_skin(rng):
    """Nor does one at whose border the surface goes on beside the image."""
    mesh, _ = scene(rng)
    camera = Camera((640, 480), np.array([[1600.0, 0, -900], [0, 1600, 240], [0, 0, 1]]), np.zeros(5), np.eye(4))
    for mask in (np.zeros((480, 640), bool), np.ones((480, 640), bool)):
        assert skin.by_mask(mesh, mask, camera).skin is None


def test_a_mask_parts_in_the_cameras_image(rng):
    mesh, _ = scene(rng)
    camera = Camera((640, 480), np.array([[1600.0, 0, 320], [0, 1600, 240], [0, 0, 1]]), np.zeros(5), np.eye(4))
    mask = np.zeros((480, 640), bool)
    mask[:, :320] = True
    parted = skin.by_mask(mesh, mask, camera)
    assert camera.project(np.asarray(parted.skin.vertices))[:, 0].max() < 320
    assert len(parted.skin.faces) + len(parted.rest.faces) == len(mesh.faces)
