"""A study in a folder: written from the world, read back into it."""

import numpy as np
import pytest
from pydicom import dcmread

from recon.dicom import study_files
from recon.dicom.patient_fields import Patient
from recon.dicom.study_objects import Results
from recon.errors import InputError
from recon.geometry import rigid
from recon.segmentation.mass_files import FoundMass
from tests.recon.dicom import made_results


@pytest.mark.parametrize("patient", [Patient(), made_results.SUPINE, Patient(axes=("feet", "left", "front"))])
def test_all_comes_back_into_the_world(patient, tmp_path):
    """Within 0.01 mm and one grey level, wherever the patient lies; by float32 it is 1e-4 mm."""
    given = made_results.results()
    made_results.written(tmp_path, patient)
    found = study_files.read(tmp_path)
    assert (found.volume.voxels == given.volume.voxels).all()
    last = np.array([given.volume.voxels.shape[::-1]], float)
    ends = rigid.apply(found.volume.world_from_voxel, last), rigid.apply(given.volume.world_from_voxel, last)
    assert np.abs(ends[0] - ends[1]).max() < 1e-8
    for name, mesh in {**{name: mass.mesh for name, mass in given.masses.items()}, "skin": given.skin}.items():
        assert np.abs(found.surfaces[name].vertices - mesh.vertices).max() < 1e-4
    for name, mass in given.masses.items():
        centre = [found.figures[name][f"centre_{axis}_mm"] for axis in "xyz"]
        assert np.abs(centre - mass.mesh.center_mass).max() < 1e-4
        assert found.masks[name].any()


def test_a_search_without_masses_has_a_report(tmp_path):
    given = made_results.results()
    objects = made_results.written(
        tmp_path, found=Results(given.volume, {}, None, ("Masses were looked for: none was measured.",))
    )
    assert list(objects) == ["report.dcm", "volume.dcm"]
    assert study_files.read(tmp_path).figures == {}


def test_a_volume_alone_has_none(tmp_path):
    lines = study_files.write(tmp_path, Results(made_results.volume(), {}), Patient(), searched=False)
    assert [path.name for path in tmp_path.iterdir()] == ["volume.dcm"] and len(lines) == 2


def test_a_mass_beside_the_volume_is_named(tmp_path):
    """It has a surface, but neither a segment nor measurements that would refer to one."""
    given = made_results.results()
    beside = FoundMass(given.masses["mass1"].mesh.copy().apply_translation([0, 0, 100]), {})
    lines = study_files.write(
        tmp_path, Results(given.volume, {**given.masses, "mass2": beside}), made_results.SUPINE, searched=True
    )
    assert any("mass2 has no voxel of the volume" in line for line in lines)
    found = study_files.read(tmp_path)
    assert "mass2" in found.surfaces and "mass2" not in found.masks and "mass2" not in found.figures
    texts = [str(one.value) for one in dcmread(tmp_path / "report.dcm").iterall() if one.keyword == "TextValue"]
    assert "mass2, 65 mm3, has no voxel of the volume." in texts


def test_files_of_two_studies_are_refused(tmp_path):
    for name, patient in (("one", Patient()), ("other", Patient(id="X"))):
        (tmp_path / name).mkdir()
        made_results.written(tmp_path / name, patient)
    for name in ("masses.dcm", "surfaces.dcm", "report.dcm"):
        mine = tmp_path / "one" / name
        whole = mine.read_bytes()
        mine.write_bytes((tmp_path / "other" / name).read_bytes())
        with pytest.raises(InputError, match=rf"{name}: \w*FrameOfReferenceUID: expected the volume's"):
            study_files.read(tmp_path / "one")
        mine.write_bytes(whole)
