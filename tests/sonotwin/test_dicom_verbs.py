"""`sonotwin export layout=dicom` and `import-results`: results to a hospital's archive and back, by one line each."""

import json

import numpy as np
import pytest
import trimesh
from pydicom import dcmread

from recon.files import meshes, metrics, volumes
from recon.geometry import rigid
from recon.segmentation import mass_files
from sonotwin.cli import main
from tests.recon.dicom import made_results

LEFT_OUT = {
    "reason": "weak contrast",
    "volume_mm3": 104.0,
    "centre_mm": [-5.0, -5.0, 691.0],
    "extents_mm": [6.0, 6.5, 7.0],
    "text": "a body of 104 mm3 at -5, -5, 691 mm is left out: its contrast is weak",
}


@pytest.fixture
def session(tmp_path):
    """Folders as `sonotwin reconstruct` leaves them."""
    given = made_results.results()
    for name in ("volume", "masses", "surface"):
        (tmp_path / name).mkdir()
    volumes.write_volume(tmp_path / "volume/volume.nrrd", given.volume)
    figures = {"masses": 2, "seen_probability": 0.57, "undone_most_mm": 0.0}
    for name, mass in given.masses.items():
        meshes.write_ply(tmp_path / f"masses/{name}.ply", mass.mesh)
        figures |= {f"{name}_{key}": value for key, value in mass.figures.items()}
    metrics.write(tmp_path / "masses/metrics.json", figures)
    unlikely = LEFT_OUT | {"reason": "behind the tissue", "text": "unlikely"}
    (tmp_path / "masses/left_out.json").write_text(json.dumps({"left_out": [LEFT_OUT, unlikely]}), encoding="utf-8")
    points = np.array([[x, y, 640.0 + (x * x + y * y) / 500] for x in range(-60, 61, 4) for y in range(-60, 61, 4)], float)
    corner = np.add.outer(31 * np.arange(30), np.arange(30)).ravel()
    faces = np.concatenate(
        [np.column_stack([corner, corner + 1, corner + 31]), np.column_stack([corner + 1, corner + 32, corner + 31])]
    )
    skin = trimesh.Trimesh(points, faces, process=False)
    skin.vertex_attributes["sigma_mm"] = np.full(len(points), 0.05)
    meshes.write_ply(tmp_path / "surface/surface.ply", skin)
    return tmp_path


def exported(session, *fields):
    given = (f"{name}={session / name}" for name in ("volume", "masses", "surface"))
    return main(["export", "layout=dicom", *given, f"out={session / 'study'}", *fields])


def test_results_go_out_and_come_back(session, capsys):
    """Voxels to the last bit, places to 0.01 mm, figures as they were."""
    assert exported(session) == 0
    said = capsys.readouterr().out
    assert "Anonymous^Patient" in said and "left and right may be wrong" in said
    assert main(["import-results", f"folder={session / 'study'}", f"out={session / 'back'}"]) == 0
    given, back = made_results.results(), session / "back"
    found = volumes.read_volume(back / "volume.nrrd")
    corner = [np.array(given.volume.voxels.shape[::-1], float)]
    assert (found.voxels == given.volume.voxels).all()
    away = rigid.apply(found.world_from_voxel, corner) - rigid.apply(given.volume.world_from_voxel, corner)
    assert np.abs(away).max() < 0.01
    masses = mass_files.read_masses(back)  # as fuse and project read them
    assert list(masses) == ["mass0", "mass1"]
    for name, mass in given.masses.items():
        assert np.abs(np.asarray(masses[name].mesh.vertices) - mass.mesh.vertices).max() < 0.01
        assert all(masses[name].figures[key] == pytest.approx(value) for key, value in mass.figures.items())
        mask = volumes.read_volume(back / f"{name}.nrrd").voxels
        assert mask.sum() * np.prod(given.volume.spacing) == pytest.approx(mass.mesh.volume, rel=0.15)
    skins = (meshes.read_ply(path, "a skin") for path in (back / "skin.ply", session / "surface/surface.ply"))
    one, other = (np.asarray(skin.vertices) for skin in skins)
    assert np.abs(one - other).max() < 0.01


def test_a_patient_is_named_by_a_file(session, capsys):
    (session / "patient.yaml").write_text(
        'name: Doe^Jane\nid: X1\ndate: "20261130"\naxes: [left, feet, back]\n', encoding="utf-8"
    )
    assert exported(session, f"patient={session / 'patient.yaml'}") == 0
    assert "left and right" not in capsys.readouterr().out
    one = dcmread(session / "study/volume.dcm")
    assert (one.PatientName, one.PatientID, one.StudyDate) == ("Doe^Jane", "X1", "20261130")
    first = one.PerFrameFunctionalGroupsSequence[0].PlanePositionSequence[0].ImagePositionPatient
    x, y, z = made_results.volume().origin
    assert np.allclose(np.array(first, float), [x, z, -y])
    assert main(["import-results", f"folder={session / 'study'}", f"out={session / 'back'}"]) == 0
    assert np.allclose(volumes.read_volume(session / "back/volume.nrrd").origin, [x, y, z], atol=1e-8)


def test_what_may_be_missing_stands_in_the_report(session):
    exported(session)
    texts = [str(one.value) for one in dcmread(session / "study/report.dcm").iterall() if one.keyword == "TextValue"]
    assert any("its contrast is weak" in text for text in texts) and not any("unlikely" in text for text in texts)
    assert any("would have been found with 57 %" in text for text in texts)


def test_a_volume_alone_is_enough(session):
    assert main(["export", "layout=dicom", f"volume={session / 'volume/volume.nrrd'}", f"out={session / 'study'}"]) == 0
    assert [path.name for path in session.glob("study/*.dcm")] == ["volume.dcm"]


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (["layout=dicom"], "export: volume: needs a value with layout=dicom; give volume=FOLDER of `sonotwin freehand`"),
        (["layout=dicom", "volume=none"], "none: "),
        (["layout=dicom", "volume=volume", "masses=volume"], "expected a folder of `sonotwin segment`"),
        (
            ["layout=dicom", "volume=volume", "capture=[volume]"],
            "export: capture: expected none with layout=dicom, which is of results",
        ),
        (["layout=dicom", "volume=volume", "patient=none.yaml"], "none.yaml: expected a file of a patient's fields, found none"),
        (["layout=meza2021", "capture=volume", "volume=volume"], "export: volume: expected none with layout=meza2021"),
    ],
)
def test_mistakes_are_one_line(fields, said, session, capsys, monkeypatch):
    monkeypatch.chdir(session)
    assert main(["export", *fields, "out=study"]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not (session / "study").exists()


def test_a_damaged_study_is_one_line(session, capsys):
    exported(session)
    (session / "study/masses.dcm").write_bytes((session / "study/masses.dcm").read_bytes()[:-100])
    capsys.readouterr()
    assert main(["import-results", f"folder={session / 'study'}", f"out={session / 'back'}"]) == 2
    error = capsys.readouterr().err
    assert "masses.dcm: expected a Segmentation, found it damaged" in error and error.count("\n") == 1
    assert not (session / "back").exists()
