"""The report of masses: figures as they were, laws of what is derived, the template by others' parsers."""

import shutil
import subprocess

import numpy as np
import pytest
import trimesh
from pydicom import dcmread

from recon.dicom import measurement_report
from recon.errors import InputError
from recon.geometry import rigid
from recon.segmentation.mass_files import FoundMass
from tests.recon.dicom import made_results


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    made_results.written(folder)
    return folder / "report.dcm"


def test_figures_come_back(path):
    found = measurement_report.read(path)
    assert list(found) == ["mass0", "mass1"]
    for name, value in made_results.FIGURES.items():
        assert found["mass0"][name] == pytest.approx(value, rel=1e-14)
    assert "volume_sigma_mm3" not in found["mass1"] and "depth_mm" not in found["mass1"]  # unknown, so left out
    for name, mass in made_results.results().masses.items():
        expected = rigid.apply(made_results.SUPINE.patient_from_world, mass.mesh.center_mass)
        centre = [found[name][f"centre_{axis}_mm"] for axis in "xyz"]
        assert np.abs(centre - expected).max() < 1e-4  # float32


def test_axes_of_an_ellipsoid_are_its_axes(rng):
    """However it is turned; the mesh lies within 0.3 % of it."""
    turned = trimesh.transformations.random_rotation_matrix(rng.random(3))
    mesh = trimesh.creation.icosphere(4, 1.0).apply_scale([9, 5, 3]).apply_transform(turned)
    assert measurement_report.axes(mesh) == pytest.approx([18, 10, 6], rel=3e-3)


def test_sigma_of_an_axis_is_that_of_a_border_off_by_the_same_everywhere(rng):
    """Borders drawn with 0.1 mm: the spread of volumes, put into the law, is the spread of the lengths, within 3 % ."""
    mesh, sigma_mm = trimesh.creation.icosphere(2, 1.0).apply_scale([9, 5, 3]), 0.1
    offsets = rng.normal(0, sigma_mm, 100)
    grown = (mesh.vertices + off * mesh.vertex_normals for off in offsets)
    both = [(trimesh.Trimesh(one, mesh.faces, process=False).volume, np.ptp(one, axis=0)) for one in grown]
    volumes, lengths = np.array([one for one, _ in both]), np.array([other for _, other in both])
    figures = {"volume_mm3": float(mesh.volume), "volume_sigma_mm3": float(volumes.std())}
    found = measurement_report.measured(FoundMass(mesh, figures))
    assert lengths.std(axis=0) == pytest.approx([found[f"{axis}_sigma_mm"] for axis in ("major", "middle", "minor")], rel=0.03)


def test_remarks_stand_in_it(path):
    texts = [one.value for one in dcmread(path).iterall() if one.keyword == "TextValue"]
    assert "Masses were looked for: 2 were measured." in texts


def test_highdicom_finds_groups_and_segments(path):
    """An independent implementation of TID 1500 and 1411."""
    highdicom = pytest.importorskip("highdicom")
    groups = highdicom.sr.srread(path).content.get_volumetric_roi_measurement_groups()
    assert [group.tracking_identifier for group in groups] == ["mass0", "mass1"]
    segments = dcmread(path.parent / "masses.dcm")
    for number, group in enumerate(groups, 1):
        referenced = group.referenced_segment
        assert referenced.referenced_sop_instance_uid == segments.SOPInstanceUID
        assert referenced.referenced_segment_numbers == [number]
        assert group.tracking_uid == segments.SegmentSequence[number - 1].TrackingUID
        assert group.finding_type.meaning == "Mass" and group.finding_sites[0].value.meaning == "Breast"
    volume, *_ = groups[0].get_measurements()
    assert (volume.name.meaning, volume.value, volume.unit.value) == ("Volume", made_results.FIGURES["volume_mm3"], "mm3")
    deviation, _ = volume[0].ContentSequence
    assert (deviation.name.meaning, deviation.value) == ("Standard Deviation", made_results.FIGURES["volume_sigma_mm3"])


@pytest.mark.skipif(shutil.which("dciodvfy") is None, reason="no dciodvfy, of Debian's dicom3tools")
@pytest.mark.parametrize("name", ["volume", "masses", "surfaces", "report"])
def test_dciodvfy_finds_no_error(name, path):
    said = subprocess.run(["dciodvfy", "-new", path.with_name(f"{name}.dcm")], capture_output=True, text=True, check=False).stderr
    assert not [line for line in said.splitlines() if line.startswith(("Error", "Abort"))], said


@pytest.mark.skipif(shutil.which("dsrdump") is None, reason="no dsrdump, of Debian's dcmtk")
def test_dcmtk_takes_its_tree(path):
    """It refuses items and relations that a Comprehensive 3D SR doesn't have."""
    done = subprocess.run(["dsrdump", path], capture_output=True, text=True, check=True)
    assert done.stdout.count("Measurement Group") == 2 and "E: " not in done.stderr


def group_of(one):
    (measurements,) = (each for each in one.ContentSequence if each.ConceptNameCodeSequence[0].CodeValue == "126010")
    return measurements.ContentSequence[0]


def volume_of(one):
    return next(each for each in group_of(one).ContentSequence if each.ValueType == "NUM").MeasuredValueSequence[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda one: setattr(volume_of(one), "FloatingPointValue", float("nan")), "NumericValue: expected a finite number"),
        (lambda one: setattr(volume_of(one), "FloatingPointValue", -3.0), "NumericValue: expected a finite number"),
        (
            lambda one: setattr(volume_of(one).MeasurementUnitsCodeSequence[0], "CodeValue", "cm3"),
            "MeasurementUnitsCodeSequence: expected mm3, found cm3",
        ),
        (lambda one: setattr(one.ConceptNameCodeSequence[0], "CodeValue", "111"), "expected 126000, Imaging Measurement Report"),
        (lambda one: setattr(group_of(one).ContentSequence[0], "TextValue", "mass1"), "a Tracking Identifier of its own"),
        (
            lambda one: setattr(group_of(one).ContentSequence[-1], "ReferencedFrameOfReferenceUID", "1.2"),
            "ReferencedFrameOfReferenceUID: expected the volume's",
        ),
        (lambda one: setattr(group_of(one).ContentSequence[-1], "GraphicData", [1.0, 2.0]), "GraphicData: expected 3 finite"),
    ],
)
def test_others_are_refused(change, said, path, tmp_path):
    one, frame = dcmread(path), dcmread(path.with_name("volume.dcm")).FrameOfReferenceUID
    change(one)
    one.save_as(tmp_path / "report.dcm")
    with pytest.raises(InputError, match=said) as refusal:
        measurement_report.read(tmp_path / "report.dcm", frame)
    assert "\n" not in str(refusal.value)
