"""A volume in DICOM: grey levels and places, by the standard's own equation and by other readers."""

import numpy as np
import pytest
import SimpleITK as sitk
from pydicom import dcmread

from recon.dicom import enhanced_volume
from recon.errors import InputError
from recon.files.volumes import Volume
from recon.geometry import rigid
from tests.recon.dicom import made_results

GRID = made_results.volume()


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    made_results.written(folder)
    return folder / "volume.dcm"


def corners():
    nz, ny, nx = GRID.voxels.shape
    return np.array([[i, j, k] for i in (0, nx - 1) for j in (0, ny - 1) for k in (0, nz - 1)], float)


def test_pixels_lie_where_the_volume_has_them(path):
    """In the patient by C.7.6.2.1.1; decimal strings of 16 letters are good to 1e-9 mm here."""
    one = dcmread(path)
    turn = made_results.SUPINE.patient_from_world
    for i, j, k in corners():
        expected = rigid.apply(turn @ GRID.world_from_voxel, [[i, j, k]])
        assert np.abs(made_results.places(one, int(k), np.array([[i, j]])) - expected).max() < 1e-9
    assert (one.pixel_array == GRID.voxels).all()


def test_the_world_is_the_volumes_own_frame(path):
    """Places in the volume's frame of reference (FD) are those of the world."""
    one = dcmread(path)
    for k, frame in enumerate(one.PerFrameFunctionalGroupsSequence):
        at = frame.PlanePositionVolumeSequence[0].ImagePositionVolume
        assert np.allclose(at, rigid.apply(GRID.world_from_voxel, [[0, 0, k]])[0], atol=1e-9)
    assert one.VolumeFrameOfReferenceUID != one.FrameOfReferenceUID


def test_reading_back_gives_the_same(path):
    found = enhanced_volume.read(path)
    back = found.world_from_patient @ found.volume.world_from_voxel
    assert (found.volume.voxels == GRID.voxels).all()
    away = rigid.apply(back, corners()) - rigid.apply(GRID.world_from_voxel, corners())
    assert np.abs(away).max() < 1e-8  # of 0.01 mm that are allowed


def test_sixteen_bits_stay(tmp_path):
    levels = np.random.default_rng(1).integers(0, 65536, (3, 5, 7), np.uint16)
    found = made_results.results()
    deep = type(found)(Volume(levels, GRID.origin, GRID.spacing, GRID.directions), {})
    made_results.written(tmp_path, found=deep)
    assert (enhanced_volume.read(tmp_path / "volume.dcm").volume.voxels == levels).all()


def test_frames_in_another_order_are_sorted(path, tmp_path):
    one = dcmread(path)
    order = np.random.default_rng(2).permutation(len(GRID.voxels))
    one.PixelData = np.ascontiguousarray(GRID.voxels[order]).tobytes()
    one.PerFrameFunctionalGroupsSequence = [one.PerFrameFunctionalGroupsSequence[k] for k in order.tolist()]
    one.save_as(tmp_path / "mixed.dcm")
    found, whole = enhanced_volume.read(tmp_path / "mixed.dcm").volume, enhanced_volume.read(path).volume
    voxel_of_other = np.linalg.inv(found.world_from_voxel) @ whole.world_from_voxel  # it may begin at the other end
    i, j, k = np.rint(rigid.apply(voxel_of_other, corners())).astype(int).T
    assert np.abs(rigid.apply(voxel_of_other, corners()) - np.column_stack([i, j, k])).max() < 1e-6
    assert (found.voxels[k, j, i] == whole.voxels[tuple(corners().astype(int).T[::-1])]).all()


def test_floats_are_refused_with_a_way_on():
    floats = Volume(GRID.voxels.astype(np.float32), GRID.origin, GRID.spacing)
    with pytest.raises(InputError, match=r"volume: expected voxels of 8 or 16 bits without sign.*found float32"):
        enhanced_volume.built(None, floats, np.eye(4))


def test_simpleitk_reads_its_levels(path):
    """Its places it doesn't: ITK knows none of an Enhanced US Volume."""
    assert (sitk.GetArrayFromImage(sitk.ReadImage(str(path))) == GRID.voxels).all()


def test_highdicom_places_it(path):
    """An independent reader, whose axes are those of the array (k, j, i)."""
    highdicom = pytest.importorskip("highdicom")
    found = highdicom.imread(path).get_volume()
    turned = made_results.SUPINE.patient_from_world @ GRID.world_from_voxel
    places = found.map_indices_to_reference(corners()[:, ::-1].astype(int))
    levels = found.array
    flipped = np.linalg.norm(found.affine[:3, 3] - turned[:3, 3]) > 1  # it orders slices by their normal
    if flipped:
        places = found.map_indices_to_reference(np.column_stack([len(levels) - 1 - corners()[:, 2], *corners()[:, 1::-1].T]))
        levels = levels[::-1]
    assert (levels == GRID.voxels).all()
    assert np.abs(places - rigid.apply(turned, corners())).max() < 1e-6


def in_world(one, frame):
    return one.PerFrameFunctionalGroupsSequence[frame].PlanePositionVolumeSequence[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda one: setattr(one, "NumberOfFrames", 10**9), "NumberOfFrames: expected 1 to 100000, of 14 that are described"),
        (lambda one: setattr(one, "Rows", 60000), "PixelData: expected 18480000 bytes.*found 5544: cut short?"),
        (lambda one: setattr(one, "PixelData", one.PixelData[:-2]), "PixelData: expected 5544 bytes"),
        (lambda one: setattr(one, "PhotometricInterpretation", "RGB"), "expected grey levels of 8 or 16 bits"),
        (lambda one: setattr(in_world(one, 3), "ImagePositionVolume", [0.0, np.nan, 0.0]), "expected 3 finite numbers"),
        (lambda one: setattr(in_world(one, 3), "ImagePositionVolume", [0.0, 0.0, 650.0]), "frames one behind the other, evenly"),
        (
            lambda one: setattr(shared(one).PlaneOrientationSequence[0], "ImageOrientationPatient", [1, 0, 0, 1, 0, 0]),
            "two unit vectors at right angles",
        ),
        (lambda one: setattr(shared(one).PixelMeasuresSequence[0], "PixelSpacing", [0, 1]), "pixels apart from each other"),
        (lambda one: shared(one).__delitem__("PlaneOrientationSequence"), "found it damaged"),
    ],
)
def test_others_are_refused(change, said, path, tmp_path):
    one = dcmread(path)
    change(one)
    one.save_as(tmp_path / "volume.dcm")
    with pytest.raises(InputError, match=said) as refusal:
        enhanced_volume.read(tmp_path / "volume.dcm")
    assert "\n" not in str(refusal.value)


def shared(one):
    return one.SharedFunctionalGroupsSequence[0]
