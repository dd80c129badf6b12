"""Masses as segments: balls of known size and place, read back and by others' software."""

import numpy as np
import pytest
import SimpleITK as sitk
from pydicom import dcmread

from recon.dicom import enhanced_volume, mass_segments
from recon.errors import InputError
from recon.geometry import rigid
from tests.recon.dicom import made_results

GRID = made_results.volume()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    made_results.written(folder)
    return folder


def masks(folder):
    return mass_segments.read(folder / "masses.dcm", enhanced_volume.read(folder / "volume.dcm"))


def test_voxels_are_those_whose_middles_lie_in_the_ball(folder):
    """But for those within 0.02 mm of the border: the ball is a polyhedron, up to 0.01 mm within its sphere."""
    nz, ny, nx = GRID.voxels.shape
    k, j, i = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
    places = rigid.apply(GRID.world_from_voxel, np.stack([i, j, k], axis=-1).reshape(-1, 3)).reshape(nz, ny, nx, 3)
    for (name, mask), radius in zip(masks(folder).items(), made_results.RADII_MM, strict=True):
        centre = made_results.results().masses[name].mesh.center_mass
        away = np.linalg.norm(places - centre, axis=-1)
        sure = np.abs(away - radius) > 0.02
        assert (mask == (away < radius))[sure].all() and mask.sum() > 40


def test_only_slices_that_show_something_are_stored(folder):
    one = dcmread(folder / "masses.dcm")
    assert one.NumberOfFrames == sum(mask.any(axis=(1, 2)).sum() for mask in masks(folder).values())
    assert one.SegmentsOverlap == "NO"
    volume = dcmread(folder / "volume.dcm")
    for group in one.PerFrameFunctionalGroupsSequence:  # which slice of the volume it is, by number and by place
        referenced = group.DerivationImageSequence[0].SourceImageSequence[0]
        slice_of = volume.PerFrameFunctionalGroupsSequence[referenced.ReferencedFrameNumber - 1]
        assert referenced.ReferencedSOPInstanceUID == volume.SOPInstanceUID
        assert group.PlanePositionSequence == slice_of.PlanePositionSequence


def test_simpleitk_sees_them_in_place(folder):
    """All pixels that ITK places lie in one of the balls in the patient, or within a voxel's half diagonal of it."""
    image = sitk.ReadImage(str(folder / "masses.dcm"))
    one = dcmread(folder / "masses.dcm")
    frames = sitk.GetArrayFromImage(image)[: one.NumberOfFrames]
    assert frames.astype(bool).sum() == sum(mask.sum() for mask in masks(folder).values())
    turn = made_results.SUPINE.patient_from_world
    for frame, group in zip(range(len(frames)), one.PerFrameFunctionalGroupsSequence, strict=True):
        number = group.SegmentIdentificationSequence[0].ReferencedSegmentNumber - 1
        centre = rigid.apply(turn, made_results.results().masses[f"mass{number}"].mesh.center_mass)
        pixels = np.argwhere(frames[frame])[:, ::-1]
        away = np.linalg.norm(made_results.places(one, frame, pixels) - centre, axis=1)
        assert (away < made_results.RADII_MM[number] + 0.02).all()


def test_highdicom_reads_the_same_masks(folder):
    highdicom = pytest.importorskip("highdicom")
    found = highdicom.seg.segread(folder / "masses.dcm")
    volume = dcmread(folder / "volume.dcm")
    read = found.get_pixels_by_source_frame(
        source_sop_instance_uid=volume.SOPInstanceUID,
        source_frame_numbers=list(range(1, len(GRID.voxels) + 1)),
        segment_numbers=[1, 2],
        assert_missing_frames_are_empty=True,
    )
    for number, mask in enumerate(masks(folder).values()):
        assert (read[..., number].astype(bool) == mask).all()
    assert found.get_segment_description(1).segmented_property_type.meaning == "Mass"


def test_the_part_within_the_volume_is_marked():
    """Of balls that stand out of it anywhere, or contain its corner, or lie beside it."""
    nz, ny, nx = GRID.voxels.shape
    k, j, i = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
    places = rigid.apply(GRID.world_from_voxel, np.stack([i, j, k], axis=-1).reshape(-1, 3)).reshape(nz, ny, nx, 3)
    middles = [(0, 0, 0), (21, 17, 13), (-3, 9, 7), (30, 9, 7), (-200, 9, 7), (10, 9, 300)]
    for at in middles:
        mesh = made_results.ball(at, 6.0)
        away = np.linalg.norm(places - mesh.center_mass, axis=-1)
        sure = np.abs(away - 6.0) > 0.02
        assert (mass_segments.rasterised(mesh, GRID) == (away < 6.0))[sure].all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda one: setattr(one, "FrameOfReferenceUID", "1.2.3"), "FrameOfReferenceUID: expected the volume's"),
        (lambda one: setattr(one, "SegmentationType", "FRACTIONAL"), "SegmentationType: expected BINARY"),
        (lambda one: setattr(one, "Rows", 17), "Rows: expected 22x18, as the volume has, found 22x17"),
        (lambda one: setattr(one, "NumberOfFrames", 10**9), "NumberOfFrames: expected 1 to 100000"),
        (lambda one: setattr(one, "PixelData", one.PixelData[:-10]), "PixelData: expected .* cut short?"),
        (lambda one: setattr(one.SegmentSequence[1], "SegmentLabel", "mass0"), "SegmentSequence: expected segments, each with"),
        (lambda one: setattr(one.SegmentSequence[1], "SegmentNumber", 7), "ReferencedSegmentNumber: expected one of"),
        (lambda one: moved(one, 0.02), "ImagePositionPatient: expected frames on slices of the volume, to 0.01 mm"),
    ],
)
def test_others_are_refused(change, said, folder, tmp_path):
    one = dcmread(folder / "masses.dcm")
    change(one)
    one.save_as(tmp_path / "masses.dcm")
    with pytest.raises(InputError, match=said) as refusal:
        mass_segments.read(tmp_path / "masses.dcm", enhanced_volume.read(folder / "volume.dcm"))
    assert "\n" not in str(refusal.value)


def moved(one, by_mm):
    at = one.PerFrameFunctionalGroupsSequence[2].PlanePositionSequence[0]
    x, y, z = map(float, at.ImagePositionPatient)
    at.ImagePositionPatient = [f"{x + by_mm:.6f}", f"{y:.6f}", f"{z:.6f}"]
