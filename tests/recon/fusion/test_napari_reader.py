"""Results as napari's layers: in place, by the right side out, with their uncertainty; napari itself isn't needed."""

import json
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from recon.errors import InputError
from recon.files import meshes, metrics, volumes
from recon.files.volumes import Volume
from recon.fusion import napari_reader

CENTRES = ("centres, 95 %", "centres, uncertainty unknown")
TURNED = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
FIGURES = {"mass0_volume_mm3": 500.0, "mass0_centre_sigma_mm": 0.2, "mass1_volume_mm3": 60.0}


@pytest.fixture
def result(tmp_path) -> Path:
    """A folder as `reconstruct` leaves it, with two masses, one of unknown uncertainty."""
    voxels = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)
    for place in ("volume/scan", "masses/scan", "surface"):
        (tmp_path / place).mkdir(parents=True)
    volumes.write_volume(
        tmp_path / "volume/scan/volume.nrrd", Volume(voxels, np.array([1.0, 2, 3]), np.array([0.5, 1, 2]), TURNED)
    )
    for number, place in enumerate([(10.0, 20, 30), (0.0, -5, 60)]):
        ball = trimesh.creation.icosphere(radius=4 - number).apply_translation(place)
        meshes.write_ply(tmp_path / f"masses/scan/mass{number}.ply", ball)
    metrics.write(tmp_path / "masses/scan" / metrics.FILE, FIGURES)
    gap = {"reason": "gap", "volume_mm3": 1.0, "centre_mm": [1.0, 2, 3], "extents_mm": [1.0, 1, 1], "text": "a gap"}
    (tmp_path / "masses/scan/left_out.json").write_text(json.dumps({"left_out": [gap]}), encoding="utf-8")
    meshes.write_ply(tmp_path / "surface/surface.ply", trimesh.creation.box((10, 20, 1)))
    return tmp_path


def layers(result: Path) -> dict[str, tuple]:
    read = napari_reader.find(str(result))
    assert read is not None
    return {told["name"]: (data, told, kind) for data, told, kind in read(str(result))}


def test_all_results_are_layers_in_the_world(result):
    """Voxels by their affine transform, surfaces and centres by their coordinates, all as z, y, x."""
    found = layers(result)
    kinds = {name: kind for name, (_, _, kind) in found.items()}
    surfaces = dict.fromkeys(("surface", "mass0", "mass1"), "surface")
    assert kinds == {"volume": "image", **surfaces, **dict.fromkeys((*CENTRES, "left out"), "points")}
    voxels, told, _ = found["volume"]
    index = np.array([1, 2, 3])  # z, y, x
    place = (told["affine"] @ np.append(index, 1))[:3][::-1]
    assert voxels[tuple(index)] == 23 and place == pytest.approx(np.array([1, 2, 3]) + TURNED @ (index[::-1] * [0.5, 1, 2]))
    (vertices, faces), *_ = found["mass0"]
    mirrored = trimesh.Trimesh(vertices, faces, process=False)
    assert mirrored.volume > 0 and mirrored.center_mass == pytest.approx([30, 20, 10]), "the outside stays outside"
    assert found["left out"][0].tolist() == [[3.0, 2.0, 1.0]]


def test_centres_are_as_large_as_they_are_uncertain(result):
    """By 1.96 sigma as radius; a mass of unknown uncertainty stands apart."""
    found = layers(result)
    (centres, told, _), (others, without, _) = (found[name] for name in CENTRES)
    assert centres == pytest.approx(np.array([[30, 20, 10]]), abs=1e-5) and others == pytest.approx(
        np.array([[60, -5, 0]]), abs=1e-5
    )
    assert told["size"] == pytest.approx([2 * 1.96 * 0.2])
    assert told["features"] == {"mass": ["mass0"], "volume_mm3": [500.0], "centre_sigma_mm": [0.2]}
    assert without["features"] == {"mass": ["mass1"], "volume_mm3": [60.0]}, "an unknown sigma is no small one"


def test_others_folders_are_left_to_others(tmp_path, result):
    empty = tmp_path / "empty"
    empty.mkdir()
    assert napari_reader.find(str(empty)) is None and napari_reader.find([str(result)]) is None
    assert napari_reader.find(str(result / "surface/surface.ply")) is None
    (result / "masses/scan/mass0.ply").write_bytes(b"ply\n")
    with pytest.raises(InputError, match=r"mass0\.ply"):
        layers(result)


def test_napari_finds_the_reader(request):
    """The entry point names the manifest, and that the reader."""
    import tomllib

    root = request.config.rootpath
    named = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]["napari.manifest"]
    package, _, file = named["sonotwin"].partition(":")
    folder = Path(import_module(package).__path__[0])
    manifest = yaml.safe_load((folder / file).read_text(encoding="utf-8"))
    (command,), (reader,) = (manifest["contributions"][kind] for kind in ("commands", "readers"))
    assert EntryPoint("sonotwin", command["python_name"], "").load() is napari_reader.find
    assert reader["command"] == command["id"] and reader["accepts_directories"]
