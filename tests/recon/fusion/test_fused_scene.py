"""Layers of a scene: where they are, what they show, and that a viewer's file holds them by name."""

import json
import struct

import numpy as np
import pytest
import trimesh

from recon.files import meshes
from recon.fusion import fused_scene
from recon.fusion.palette import IN_SPACE
from recon.geometry import rigid
from recon.geometry.camera import Camera
from scenes.solid_meshes import grid


def test_a_b_scan_lies_where_it_was_taken():
    """Its corners are the outer borders of its corner pixels."""
    world_from_pixel = rigid.from_rotation_vector([0.3, -0.2, 0.1], [5, 6, 600]) @ np.diag([0.12, 0.11, 1.0, 1.0])
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    layer = fused_scene.scan_layer(image, world_from_pixel)
    pixels = np.array([[-0.5, -0.5], [3.5, -0.5], [3.5, 2.5], [-0.5, 2.5]])
    assert np.asarray(layer.vertices) == pytest.approx(rigid.apply(world_from_pixel, np.column_stack([pixels, np.zeros(4)])))
    assert np.array_equal(np.asarray(layer.visual.material.baseColorTexture), image)


def test_a_viewers_file_has_the_layers_by_name_in_metres_and_images_the_right_way_up(tmp_path):
    """In glTF, v of a texture grows downwards from the image's upper edge, as a B-scan's depth does."""
    scan = fused_scene.scan_layer(np.zeros((30, 20), np.uint8), np.diag([1.0, 1.0, 1.0, 1.0]))
    mass = meshes.painted(trimesh.creation.icosphere(radius=5.0), IN_SPACE.mass)
    meshes.write_layers(tmp_path / "scene.glb", {"scan0000": scan, "mass0": mass})
    data = (tmp_path / "scene.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    content, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    assert {"scan0000", "mass0"} <= {node.get("name") for node in content["nodes"]}
    mesh = next(mesh for mesh in content["meshes"] if mesh["name"] == "scan0000")["primitives"][0]["attributes"]

    def read(name: str, width: int) -> np.ndarray:
        accessor = content["accessors"][mesh[name]]
        view = content["bufferViews"][accessor["bufferView"]]
        first = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(binary, "<f4", width * accessor["count"], first).reshape(-1, width)

    places, uv = read("POSITION", 3) * 1000, read("TEXCOORD_0", 2)
    assert places[:, 0] + 0.5 == pytest.approx(20 * uv[:, 0], abs=1e-3), "x is the column"
    assert -places[:, 1] + 0.5 == pytest.approx(30 * uv[:, 1], abs=1e-3), "y is up, and the row grows downwards"


def test_vertices_are_merged_and_the_shape_stays(rng):
    points, triangles = grid((40.0, 30.0), (160, 120))
    height = 3 * np.sin(points[:, 0] / 6)
    mesh = trimesh.Trimesh(np.column_stack([points, height]), triangles, process=False)
    coarse = fused_scene.merged(mesh, 1.0)
    assert len(coarse.vertices) < len(mesh.vertices) / 8
    assert coarse.area == pytest.approx(mesh.area, rel=0.03)
    assert np.abs(coarse.vertices[:, 2] - 3 * np.sin(coarse.vertices[:, 0] / 6)).max() < 0.15


def test_the_path_is_a_tube():
    places = np.array([[0, 0, 600], [10, 0, 600], [10, 5, 600]], float)
    tube = fused_scene.path_layer(np.stack([places[:-1], places[1:]], axis=1))
    assert np.asarray(tube.bounds)[:, 0] == pytest.approx([0, 10], abs=0.7)
    assert tube.volume == pytest.approx(15 * 0.6**2 * 3 * np.sqrt(3) / 2, rel=0.02), "a hexagon's cross-section"


def test_a_device_looks_where_its_camera_does():
    turned = rigid.from_rotation_vector([0, -0.3, 0], [-170, 0, 40])
    camera = Camera((640, 480), np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), np.zeros(5), turned)
    layer = fused_scene.device_layer(camera)
    assert np.asarray(layer.vertices[0]) == pytest.approx(camera.centre)
    away = np.asarray(layer.vertices[1:]).mean(axis=0) - camera.centre
    assert away / np.linalg.norm(away) == pytest.approx(camera.rays(np.array([319.5, 239.5])), abs=1e-3)


@pytest.mark.parametrize(("count", "expected"), [(3, [2, 3, 9]), (100, [2, 3, 5, 9]), (0, [])])
def test_b_scans_are_chosen_evenly_from_those_with_a_pose(count, expected):
    placed = np.isin(np.arange(10), [2, 3, 5, 9])
    assert fused_scene.chosen(placed, count) == expected
    assert fused_scene.chosen(np.zeros(4, bool), count) == []


def test_a_viewers_file_has_the_skins_grey(tmp_path):
    ball = trimesh.creation.icosphere(4, 30.0)
    meshes.set_greys(ball, np.full(len(ball.vertices), 90, np.uint8))
    meshes.write_layers(tmp_path / "scene.glb", {"skin": fused_scene.surface_layer(ball, IN_SPACE.skin, fused_scene.GREY_SKIN)})
    data = (tmp_path / "scene.glb").read_bytes()
    content = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    assert "COLOR_0" in content["meshes"][0]["primitives"][0]["attributes"]
