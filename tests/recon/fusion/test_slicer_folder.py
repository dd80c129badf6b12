"""Does 3D Slicer find everything where it was measured? Read with the formats' own libraries."""

import json
import runpy
import sys
from dataclasses import replace
from types import SimpleNamespace

import nrrd
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh

from recon.fusion import fused_scene, probe_shape, scene_page, slicer_folder
from recon.geometry import rigid
from recon.segmentation.seen_map import SeenFiles, Table


def test_everything_is_there(folder):
    assert {path.name for path in folder.iterdir()} == {
        "skin.ply", "mass0.ply", "path.ply", "volume.nrrd", "scan0000.nrrd", "scan0004.nrrd", "target_probe.ply",
        "target_circles.ply", "target_to_world.tfm", "masses.mrk.json", "left_out.mrk.json", "show.py", "README.txt",
        "centre_mass0.ply", "search.txt",
    }  # fmt: skip


def test_what_was_left_out_is_a_point_with_its_reason(folder, scene):
    """In the folder for 3D Slicer, and in the page's table."""
    (point,) = json.loads((folder / "left_out.mrk.json").read_text(encoding="utf-8"))["markups"][0]["controlPoints"]
    assert (point["label"], point["description"], point["position"]) == ("small", "is left out", [1.0, 2.0, 660.0])
    _, table = scene_page.numbers(scene)
    assert table.title == "Left out" and "1, 2, 660" in str(table)


def test_what_was_seen_is_a_table_and_a_layer(scene, tmp_path):
    """The unseen places are a model for 3D Slicer, a layer of the scene, and one of the page that is off at first."""
    box = trimesh.creation.box((20, 30, 40)).apply_translation([5, 0, 670])
    table = Table(size_mm=8, contrast_db=8, sizes_mm=(4.0, 8.0), contrasts_db=(5.0, 15.0), shares=((0.1, 0.254), (0.5, 1.0)))
    seen = replace(scene, seen=SeenFiles(tmp_path / "seen.nrrd", table, box))
    slicer_folder.write(tmp_path / "slicer", seen, {}, scans=1)
    assert trimesh.load_mesh(tmp_path / "slicer" / "unseen.ply").bounds == pytest.approx(box.bounds)
    assert fused_scene.layers(seen, 1)["unseen"].bounds == pytest.approx(box.bounds)
    *_, section = scene_page.numbers(seen)
    assert section.title == "Seen" and all(word in section.blocks[0] for word in ("8 mm", "15 dB", "25\xa0%", "100\xa0%"))
    assert "by assumed coefficients" in section.blocks[0]
    shown = {shape.name: shape.shown for shape in scene_page._bodies(seen)}
    assert shown == {"skin": True, "mass0": True, "unseen": False}


def test_a_b_scan_is_a_slice_where_it_was_taken(folder, scene):
    """By ITK, as Slicer reads volumes: its pixel (u, v) has the grey level and the place that it was taken with."""
    image = sitk.ReadImage(str(folder / "scan0004.nrrd"))
    for u, v in ((0, 0), (29, 0), (7, 33)):
        place = rigid.apply(scene.scans.world_from_pixel[4], np.array([u, v, 0.0]))
        assert image.TransformIndexToPhysicalPoint((u, v, 0)) == pytest.approx(place, abs=1e-6)
        assert image.GetPixel(u, v, 0) == scene.images[4][v, u]
    _, header = nrrd.read(str(folder / "scan0004.nrrd"))
    assert header["space"] == "left-posterior-superior"


def test_the_probe_under_its_transform_is_where_its_array_met_the_skin(folder, scene):
    """Slicer places a node by the inverse of ITK's transform; the face of the housing is the B-scan's first row."""
    inverse = sitk.ReadTransform(str(folder / "target_to_world.tfm")).GetInverse()
    probe = trimesh.load_mesh(folder / "target_probe.ply")
    world = np.array([inverse.TransformPoint(vertex) for vertex in np.asarray(probe.vertices).tolist()])
    matrix = scene.scans.world_from_pixel[2]
    local = rigid.apply(np.linalg.inv(matrix), world)
    below = local[:, 1] * np.linalg.norm(matrix[:3, 1])
    assert below.max() == pytest.approx(0, abs=1e-3), "nothing of it reaches into the tissue"
    at_face = local[np.abs(below) < 1e-3, 0]
    assert at_face.min() < 0 and at_face.max() > 29


def test_the_path_does_not_cross_gaps_and_begins_at_the_face(scene):
    """Between B-scans without a pose nothing was measured; on an uncropped screen the face isn't at row 0."""
    matrices = scene.scans.world_from_pixel.copy()
    matrices[2] = np.nan
    lower = replace(scene.scans, world_from_pixel=matrices, probe=replace(scene.scans.probe, face_row=10.0))
    pieces, face = replace(scene, scans=lower).path, np.array([14.5, 10.0, 0.0])
    assert pieces.shape == (2, 2, 3)
    assert pieces[0, 0] == pytest.approx(rigid.apply(matrices[0], face)) and pieces[1, 1] == pytest.approx(
        rigid.apply(matrices[4], face)
    )
    housings = [probe_shape.of(scene.target, probe, 30)[0] for probe in (scene.scans.probe, lower.probe)]
    moved = housings[1].vertices[8:16] - housings[0].vertices[8:16]
    assert moved == pytest.approx(np.tile(10 * lower.probe.scale[1] * lower.probe.target_from_image[:3, 1], (8, 1)))


def test_a_probe_at_rest_has_no_path(scene):
    """Nor has a scene of it a layer for one; a rest amid a sweep leaves the path before and after it."""
    resting = scene.scans.world_from_pixel.copy()
    resting[1] = resting[0]
    assert len(replace(scene, scans=replace(scene.scans, world_from_pixel=resting)).path) == len(scene.path) - 1
    still = replace(scene, scans=replace(scene.scans, world_from_pixel=np.repeat(resting[:1], len(resting), axis=0)))
    assert len(still.path) == 0 and "path" not in fused_scene.layers(still, 1)


def test_markups_lie_in_the_masses_and_hold_their_uncertainty(folder, scene):
    (one,) = json.loads((folder / "masses.mrk.json").read_text())["markups"]
    (point,) = one["controlPoints"]
    model = trimesh.load_mesh(folder / "mass0.ply")
    assert one["coordinateSystem"] == "LPS" and point["label"] == "mass0"
    assert point["position"] == pytest.approx(model.center_mass, abs=1e-3)
    assert "± 0.21 mm" in point["description"] and "7.50 ± 0.19 mm below the skin" in point["description"]


def test_the_script_loads_every_file_and_puts_the_probe_under_its_transform(folder, monkeypatch):
    """In a stand-in for Slicer's Python, which notes what is asked of it."""
    loaded, under = [], []

    def load(path):
        loaded.append(path.rpartition("/")[2])
        display = SimpleNamespace(SetColor=lambda *colour: None, SetOpacity=lambda value: None)
        placed = lambda node: under.append((loaded[-1], node))  # noqa: E731
        return SimpleNamespace(GetDisplayNode=lambda: display, SetAndObserveTransformNodeID=placed, GetID=lambda: "transform")

    util = SimpleNamespace(loadModel=load, loadVolume=load, loadTransform=load, loadMarkups=load)
    monkeypatch.setitem(sys.modules, "slicer", SimpleNamespace(util=util))
    runpy.run_path(str(folder / "show.py"), run_name="__main__")
    assert set(loaded) == {path.name for path in folder.iterdir()} - {"show.py", "README.txt", "search.txt"}
    assert under == [("target_circles.ply", "transform"), ("target_probe.ply", "transform")]


def test_a_search_that_failed_is_not_one_that_found_nothing(scene, tmp_path):
    """Nor is either one that was not made: on the page, and for those who open the folder alone."""
    outcomes = {"found": scene, "none": replace(scene, masses={}), "unsought": replace(scene, masses=None)}
    outcomes["failed"] = replace(scene, masses=None, search_failed="too dark")
    tiles, said = {}, {}
    for name, one in outcomes.items():
        slicer_folder.write(tmp_path / name, one, {}, scans=0)
        said[name] = (tmp_path / name / "README.txt").read_text(encoding="utf-8").splitlines()[-1]
        top = scene_page.opening(one, "")
        tiles[name] = top.figures[-1]
        assert name == "found" or said[name] in top.result
    assert len(set(tiles.values())) == len(set(said.values())) == 4
    assert (tiles["found"][1], tiles["none"][1]) == ("1", "0") and "0" not in tiles["failed"] + tiles["unsought"]
    assert "too dark" in said["failed"]


def test_the_page_has_the_view_its_slider_and_the_masses(scene, tmp_path):
    scene_page.write(tmp_path / "scene.html", scene, "a <title>")
    page = (tmp_path / "scene.html").read_text(encoding="utf-8")
    assert 'data-slide="scene"' in page and "7.50\u00a0±\u00a00.19" in page and "a &lt;title&gt;" in page
    reel = scene_page.reel_of(scene)
    assert [sheet.image is scene.images[k] for sheet, k in zip(map(reel.sheet_at, range(3)), (0, 2, 4), strict=True)] == [
        True
    ] * 3
    low, high = reel.extent.min(axis=0), reel.extent.max(axis=0)
    for k in range(3):
        for body in reel.bodies_at(k):
            assert (body.vertices > low - 1e-6).all() and (body.vertices < high + 1e-6).all()
