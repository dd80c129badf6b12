"""`sonotwin fuse`: layers of what is given, and one line for what isn't there."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from recon.files import meshes
from recon.segmentation import insonation, seen_map
from scenes.solid_meshes import grid
from sonotwin.cli import main
from tests.recon import pose_stacks, sweep_sets


@pytest.fixture
def given(rig, tmp_path) -> list[str]:
    sweep_sets.ball(tmp_path / "capture", rig, lag_s=0.05)
    points, triangles = grid((60.0, 60.0), (60, 60))
    skin = trimesh.Trimesh(np.column_stack([points, np.full(len(points), 690.0)]), triangles, process=False)
    meshes.write_ply(tmp_path / "skin.ply", skin)
    (tmp_path / "masses").mkdir()
    ball = trimesh.creation.icosphere(radius=sweep_sets.BALL_MM)
    ball.apply_translation(sweep_sets.BALL)
    meshes.write_ply(tmp_path / "masses" / "mass0.ply", ball)
    (tmp_path / "masses" / "metrics.json").write_text("{}")
    return [f"capture={tmp_path / 'capture'}", "lag_s=0.05", "scans=3", f"out={tmp_path / 'out'}"]


def names(path: Path) -> list[str]:
    data = path.read_bytes()
    content = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    return sorted(node["name"] for node in content["nodes"] if "mesh" in node)


def test_layers_of_all_that_is_given(given, tmp_path):
    assert main(["fuse", *given, f"surface={tmp_path / 'skin.ply'}", f"masses={tmp_path / 'masses'}"]) == 0
    found = names(tmp_path / "out" / "scene.glb")
    assert found == ["circles", "mass0", "path", "probe", "scan0000", "scan0020", "scan0040", "skin"]


def test_what_was_seen_is_shown_where_it_was_mapped(given, tmp_path):
    """As a volume and a model for 3D Slicer, a layer, and a table of the page."""
    mapped = seen_map.look(insonation.of_sweep(pose_stacks.stack(np.arange(-15, 15.1)), pose_stacks.SHAPE))
    seen_map.write(tmp_path / "masses", mapped)
    assert main(["fuse", *given, f"masses={tmp_path / 'masses'}"]) == 0
    assert "unseen" in names(tmp_path / "out" / "scene.glb")
    assert (tmp_path / "out" / "slicer" / "seen.nrrd").read_bytes() == (tmp_path / "masses" / "seen.nrrd").read_bytes()
    assert (tmp_path / "out" / "slicer" / "unseen.ply").is_file()
    assert "<h2>Seen" in (tmp_path / "out" / "scene.html").read_text(encoding="utf-8")


def test_less_is_less(given, tmp_path):
    assert main(["fuse", *given]) == 0
    assert names(tmp_path / "out" / "scene.glb") == ["circles", "path", "probe", "scan0000", "scan0020", "scan0040"]


def test_the_same_input_gives_the_same_bytes(given, tmp_path):
    assert main(["fuse", *given]) == 0
    before = (tmp_path / "out" / "scene.glb").read_bytes()
    assert main(["fuse", *given]) == 0
    assert (tmp_path / "out" / "scene.glb").read_bytes() == before


@pytest.mark.parametrize(("field", "complaint"), [
    ("surface=none.ply", "none.ply: expected"),
    ("masses=nowhere", "nowhere: expected a folder of `sonotwin segment`, found neither mass0.ply nor metrics.json in it"),
    ("volume=nowhere", "nowhere: expected a folder of `sonotwin freehand`, found no volume.nrrd in it"),
    ("mask=mask.png surface=skin.ply", "mask.png: expected the calibration of cam1, in whose image it is, found no calibration"),
    ("calibration=none.yaml", "none.yaml: expected"),
    ("scans=-1", "fuse: scans: expected"),
])  # fmt: skip
def test_bad_input_is_one_line(given, tmp_path, capsys, field, complaint):
    fields = field.replace("surface=skin", f"surface={tmp_path}/skin").split()
    assert main(["fuse", *given, *fields]) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()
