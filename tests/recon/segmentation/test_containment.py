"""Does an object lie under the surface that the cameras saw?"""

import re

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.segmentation.containment import below, contain, read_skin

DOME_MM, MIDDLE = 60.0, np.array([5.0, -3.0, 690.0])


@pytest.fixture(scope="module")
def dome():
    """The cap of a sphere that faces a camera at the origin, open below, with the winding that the camera sees as its back."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=DOME_MM)
    front = (sphere.triangles_center[:, 2] < -15).nonzero()[0]
    cap = sphere.submesh([front], append=True)
    return trimesh.Trimesh(cap.vertices + MIDDLE, cap.faces[:, ::-1], process=False)


def test_depth_is_the_distance_to_the_skin(dome, rng):
    """Facets of 2 mm on a radius of 60 sag by 0.01 mm; half an edge beside the nearest vertex, 1 mm, adds 0.03 at 15 mm."""
    direction = rng.normal(size=(300, 3)) * 0.4 - [0, 0, 1]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction[direction[:, 2] < -0.5]
    radius = rng.uniform(45, 70, len(direction))
    found, normals, _ = below(MIDDLE + radius[:, None] * direction, dome)
    assert np.abs(found - (DOME_MM - radius)).max() < 0.1
    assert np.isfinite(found).all()
    assert (normals * direction).sum(axis=1).min() > 0.998, "towards the camera: outwards, on this side"


def test_an_object_within_is_inside_and_one_that_pierces_the_skin_is_not(dome):
    within = trimesh.creation.icosphere(radius=8).apply_translation(MIDDLE - [10, 5, 35])
    piercing = trimesh.creation.icosphere(radius=8).apply_translation(MIDDLE - [0, 0, 54])
    deep, through = contain([within, piercing], dome)
    assert deep.inside
    assert -deep.normal @ (within.vertices[deep.nearest] - MIDDLE) < 0
    assert deep.least_mm == pytest.approx(DOME_MM - 8 - np.linalg.norm([10, 5, 35]), abs=0.15)
    assert through.inside is False
    assert through.least_mm == pytest.approx(-2, abs=0.1)
    assert contain([], dome) == []


def test_what_lies_beside_the_surface_is_not_said_to_be_inside(dome):
    beside = trimesh.creation.icosphere(radius=5).apply_translation(MIDDLE + np.array([90, 0, 0]))
    (result,) = contain([beside], dome)
    assert result.covered == 0 and result.inside is None and np.isnan(result.least_mm)


def test_less_than_half_under_the_surface_is_not_enough_to_tell(dome):
    """A ball under the rim: what is seen of it lies deep enough, but that is the smaller part; one that pierces it is outside."""
    rim = MIDDLE + np.array([58, 0, -15])
    offsets = np.array([[-5.0, 0, 3], [0, 0, 0]])
    under, through = (trimesh.creation.icosphere(radius=5).apply_translation(place) for place in rim + offsets)
    hardly, piercing = contain([under, through], dome)
    assert 0 < hardly.covered < 0.5 and hardly.least_mm > 0 and hardly.inside is None
    assert 0 < piercing.covered < 0.5 and piercing.inside is False


SQUARE = """ply
format ascii 1.0
element vertex 5
property float x
property float y
property float z
property float s
property float t
property float sigma_mm
element face 2
property list uchar int vertex_indices
end_header
9 9 9 0 0 0.9
0 0 0 0 0 0.1
1 0 0 1 0 0.2
0 1 0 0 1 0.3
1 1 0 1 1 0.4
3 1 2 3
3 2 4 3
"""


def test_each_vertex_of_a_foreign_skin_keeps_its_sigma(tmp_path):
    """Text with places in a texture and a vertex of no triangle, as other software writes it, here and once more in binary."""
    (tmp_path / "text.ply").write_text(SQUARE)
    head, body = SQUARE.replace("ascii", "binary_little_endian").split("end_header\n")
    lines = body.splitlines()
    vertices = np.array([line.split() for line in lines[:5]], "<f4").tobytes()
    faces = np.array([(3, [int(n) for n in line.split()[1:]]) for line in lines[5:]], [("n", "u1"), ("corners", "<i4", 3)])
    (tmp_path / "binary.ply").write_bytes(f"{head}end_header\n".encode() + vertices + faces.tobytes())
    for name in ("text.ply", "binary.ply"):
        skin = read_skin(tmp_path / name)
        (first, *_), (x, *_) = skin.vertex_attributes["sigma_mm"], skin.vertices[0]
        assert (first, x) == (pytest.approx(0.9), 9), name
        _, _, sigmas = below(np.array([[0.1, 0.1, 5], [0.9, 0.9, 5]]), skin)
        assert sigmas == pytest.approx([0.1, 0.4]), name


def test_a_skin_that_lacks_the_sigma_of_a_vertex_is_refused(tmp_path):
    """Of one vertex, or of all that its head announces one for."""
    path = tmp_path / "skin.ply"
    for missing in (r" 0\.3$", r" 0\.\d$"):
        path.write_text(re.sub(missing, "", SQUARE, flags=re.MULTILINE))
        with pytest.raises(InputError, match=r"^[^\n]*skin\.ply: expected a surface [^\n]*sigma_mm of each vertex, found"):
            read_skin(path)
