"""What objects of a study share: identifiers by content, and nothing of a person or a day unless given."""

import numpy as np
import pytest
from pydicom.uid import UID

from recon.dicom.patient_fields import Patient
from recon.dicom.study_objects import NO_DATE, NO_TIME, Results, Study
from recon.files.volumes import Volume
from recon.segmentation.mass_files import FoundMass
from tests.recon.dicom import made_results


def uids(objects):
    return {str(one.value) for each in objects.values() for one in each.iterall() if one.VR == "UI" and one.value}


def test_the_same_results_are_the_same_files(tmp_path):
    for name in ("first", "again"):
        (tmp_path / name).mkdir()
        made_results.written(tmp_path / name)
    for path in (tmp_path / "first").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


def others():
    given = made_results.results()
    voxels = given.volume.voxels.copy()
    voxels[0, 0, 0] ^= 1
    moved = Volume(given.volume.voxels, given.volume.origin + 1e-9, given.volume.spacing, given.volume.directions)
    figures = {name: FoundMass(mass.mesh, mass.figures | {"volume_mm3": 1.0}) for name, mass in given.masses.items()}
    yield Results(Volume(voxels, given.volume.origin, given.volume.spacing, given.volume.directions), given.masses, given.skin)
    yield Results(moved, given.masses, given.skin, given.remarks)
    yield Results(given.volume, figures, given.skin, given.remarks)
    yield Results(given.volume, given.masses, None, given.remarks)
    yield Results(given.volume, given.masses, given.skin, ("another",))


def test_any_other_content_has_other_identifiers():
    first = Study.of(Patient(), made_results.results()).uid("volume")
    found = [Study.of(Patient(), other).uid("volume") for other in others()]
    assert len({first, *found, Study.of(Patient(name="Doe"), made_results.results()).uid("volume")}) == len(found) + 2


def test_all_are_of_one_study_and_refer_to_each_other(tmp_path):
    objects = made_results.written(tmp_path)
    assert len(objects) == 4
    for name in ("StudyInstanceUID", "PatientID", "PatientName"):
        assert len({str(one[name].value) for one in objects.values()}) == 1
    frames = {one.FrameOfReferenceUID for name, one in objects.items() if name != "report.dcm"}
    assert len(frames) == 1
    assert len({one.SeriesInstanceUID for one in objects.values()}) == 4
    assert all(UID(one).is_valid for one in uids(objects))
    own = {one.SOPInstanceUID for one in objects.values()}
    referenced = {one.value for each in objects.values() for one in each.iterall() if one.keyword == "ReferencedSOPInstanceUID"}
    assert referenced == {objects["volume.dcm"].SOPInstanceUID, objects["masses.dcm"].SOPInstanceUID} <= own


def test_nobody_and_no_day_is_named_unless_given(tmp_path):
    for one in made_results.written(tmp_path).values():
        assert one.PatientIdentityRemoved == "YES" and one.DeidentificationMethod
        assert one.PatientName == "Anonymous^Patient" and one.PatientID.startswith("ANON-")
        days = {str(each.value) for each in one.iterall() if each.VR in ("DA", "TM", "DT")}
        assert days <= {"", NO_DATE, NO_TIME, NO_DATE + NO_TIME}


def test_what_is_given_stands_in_all(tmp_path):
    patient = Patient(name="Doe^Jané", id="X1", date="20261130", time="101500", study_uid="1.2.3", laterality="L")
    for one in made_results.written(tmp_path, patient).values():
        assert (str(one.PatientName), one.PatientID, one.StudyInstanceUID) == ("Doe^Jané", "X1", "1.2.3")
        assert one.PatientIdentityRemoved == "NO" and "DeidentificationMethod" not in one
        assert (one.StudyDate, one.ContentDate, one.ContentTime) == ("20261130", "20261130", "101500")


def test_a_turn_keeps_distances(rng):
    given = made_results.results()
    turned = given.moved(made_results.SUPINE.patient_from_world)
    for name, mass in given.masses.items():
        assert turned.masses[name].mesh.volume == pytest.approx(mass.mesh.volume, rel=1e-9)
    skin = np.asarray(given.skin.vertices) - given.volume.origin
    assert np.allclose(np.linalg.norm(skin, axis=1), np.linalg.norm(turned.skin.vertices - turned.volume.origin, axis=1))
    assert (turned.skin.vertex_attributes["sigma_mm"] == 0.05).all()
