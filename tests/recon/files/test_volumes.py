"""A voxel lies where it was put, in our eyes and in ITK's, before and after a file."""

import time

import nrrd
import numpy as np
import pytest
import SimpleITK
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.files import volumes
from recon.files.volumes import Volume

SUFFIXES = [".nrrd", ".mha"]
INDEX = (4, 2, 1)  # i, j, k


@pytest.fixture
def volume(rng):
    """Oblique, with three different spacings and lengths."""
    voxels = rng.integers(0, 256, (3, 4, 6), np.uint8)
    return Volume(voxels, rng.normal(0, 100, 3), rng.uniform(0.2, 2, 3), Rotation.random(rng=rng).as_matrix())


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint16, np.float32, np.float64])
def test_what_is_written_is_read(volume, tmp_path, suffix, dtype):
    written = Volume((volume.voxels - 3.0).astype(dtype), volume.origin, volume.spacing, volume.directions)
    volumes.write_volume(tmp_path / f"v{suffix}", written)
    read = volumes.read_volume(tmp_path / f"v{suffix}")
    assert read.voxels.dtype == dtype and np.array_equal(read.voxels, written.voxels)
    assert np.array_equal(read.origin, volume.origin)
    # NRRD holds spacing times direction, so the last bit may differ; 100 mm x 2e-16 x some
    assert np.abs(read.world_from_voxel - volume.world_from_voxel).max() < 1e-13


def test_the_same_volume_has_the_same_bytes_a_second_later(volume, tmp_path):
    def bytes_of(name: str) -> list[bytes]:
        for suffix in SUFFIXES:
            volumes.write_volume(tmp_path / f"{name}{suffix}", volume)
        return [(tmp_path / f"{name}{suffix}").read_bytes() for suffix in SUFFIXES]

    first = bytes_of("a")
    time.sleep(1.05)  # formats that hold dates have them in seconds
    assert bytes_of("b") == first


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_itk_finds_a_voxel_at_the_same_place(volume, tmp_path, suffix):
    volumes.write_volume(tmp_path / f"v{suffix}", volume)
    image = SimpleITK.ReadImage(tmp_path / f"v{suffix}")
    place = (volume.world_from_voxel @ [*INDEX, 1])[:3]
    assert np.abs(np.array(image.TransformIndexToPhysicalPoint(INDEX)) - place).max() < 1e-9
    assert image[INDEX] == volume.voxels[INDEX[::-1]]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("packed", [False, True])
def test_what_itk_writes_is_read(volume, tmp_path, suffix, packed):
    image = SimpleITK.GetImageFromArray(volume.voxels.astype(np.int16))
    image.SetOrigin(volume.origin.tolist())
    image.SetSpacing(volume.spacing.tolist())
    image.SetDirection(volume.directions.ravel().tolist())
    SimpleITK.WriteImage(image, tmp_path / f"v{suffix}", packed)
    read = volumes.read_volume(tmp_path / f"v{suffix}")
    assert np.array_equal(read.voxels, volume.voxels)
    assert np.abs(read.world_from_voxel - volume.world_from_voxel).max() < 1e-6  # ITK writes MetaImage with fewer digits


def test_ras_becomes_lps_as_in_itk(volume, tmp_path):
    """The same numbers declared RAS, as 3D Slicer's own frame is."""
    path = tmp_path / "v.nrrd"
    space = {"space": "right-anterior-superior", "kinds": ["domain"] * 3}
    axes = {"space directions": (volume.directions * volume.spacing).T, "space origin": volume.origin}
    nrrd.write(str(path), volume.voxels, space | axes, index_order="C")
    place = (volumes.read_volume(path).world_from_voxel @ [*INDEX, 1])[:3]
    assert np.abs(place - SimpleITK.ReadImage(path).TransformIndexToPhysicalPoint(INDEX)).max() < 1e-9
    assert np.abs(place - (volume.world_from_voxel @ [*INDEX, 1])[:3] * (-1, -1, 1)).max() < 1e-9


def test_the_reference_of_the_real_sweep(real):
    path = real / "tracked_sweep/volume_NN_MEAN.mha"
    read, peer = volumes.read_volume(path), SimpleITK.ReadImage(path)
    assert np.array_equal(read.voxels, SimpleITK.GetArrayFromImage(peer))
    assert tuple(read.origin) == peer.GetOrigin() and tuple(read.spacing) == peer.GetSpacing()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_cut_anywhere_or_damaged(volume, tmp_path, suffix, rng):
    whole, other = tmp_path / f"v{suffix}", tmp_path / f"other{suffix}"
    volumes.write_volume(whole, volume)
    data = np.frombuffer(whole.read_bytes(), np.uint8)
    for length in [*range(0, len(data) - 10, 13), len(data) // 2]:
        other.write_bytes(data[:length].tobytes())
        with pytest.raises(InputError) as fault:
            volumes.read_volume(other)
        assert str(other) in str(fault.value) and "\n" not in str(fault.value)
    for _ in range(200):
        damaged = data.copy()
        damaged[rng.integers(0, len(data), rng.integers(1, 4))] = rng.integers(0, 256)
        other.write_bytes(damaged.tobytes())
        try:
            volumes.read_volume(other)
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"origin": np.array([0, np.nan, 0])}, "origin: expected 3 finite numbers, found"),
        ({"spacing": np.array([1, 0, 1.0])}, "spacing: expected 3 lengths above 0, found"),
        ({"directions": np.ones((3, 3))}, "directions: expected 3 unit vectors at right angles, found"),
        ({"voxels": np.zeros((2, 2), np.uint8)}, r"voxels: expected .*, found \(2, 2\) of uint8"),
        ({"voxels": np.zeros((2, 2, 2), complex)}, r"voxels: expected .*, found \(2, 2, 2\) of complex128"),
    ],
)
def test_a_fault_in_one_line(volume, tmp_path, change, line):
    for suffix in SUFFIXES:
        with pytest.raises(InputError, match=line):
            volumes.write_volume(tmp_path / f"v{suffix}", Volume(**(vars(volume) | change)))
    assert list(tmp_path.iterdir()) == []


def test_colours_and_no_pixels_are_no_volume(volume, tmp_path):
    """They are images of sequences, and tracking alone."""
    path, colour = tmp_path / "v.mha", np.stack([volume.voxels.astype(np.uint8)] * 3, axis=-1)
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(colour, isVector=True), path)
    with pytest.raises(InputError, match=r"v.mha: ElementNumberOfChannels: expected 1, found 3"):
        volumes.read_volume(path)
    path.write_text("NDims = 3\nDimSize = 1 1 2\nElementType = MET_OTHER\nElementDataFile = LOCAL\n")
    with pytest.raises(InputError, match=r"v.mha: ElementType: expected one of MET_UCHAR, .*, found MET_OTHER"):
        volumes.read_volume(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_file(tmp_path, suffix):
    with pytest.raises(InputError, match=r"expected a file, found none"):
        volumes.read_volume(tmp_path / f"none{suffix}")
