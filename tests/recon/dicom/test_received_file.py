"""DICOM files of strangers: a value or one line, whatever the bytes."""

import tracemalloc
import zlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydicom import dcmread
from pydicom.encaps import encapsulate
from pydicom.uid import (
    ComprehensiveSRStorage,
    DeflatedExplicitVRLittleEndian,
    EnhancedUSVolumeStorage,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
)

from recon.dicom import enhanced_volume, mass_segments, measurement_report, received_file, surface_segments
from recon.errors import InputError
from tests.recon.dicom import made_results
from tests.recon.files.mutations import damaged


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    made_results.written(folder)
    return folder


def readers(folder):
    over = enhanced_volume.read(folder / "volume.dcm")
    return {
        "volume.dcm": enhanced_volume.read,
        "masses.dcm": lambda path: mass_segments.read(path, over),
        "surfaces.dcm": surface_segments.read,
        "report.dcm": measurement_report.read,
    }


@pytest.mark.parametrize("name", ["volume.dcm", "masses.dcm", "surfaces.dcm", "report.dcm"])
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_gives_a_value_or_one_line(name, folder, tmp_path, data):
    (tmp_path / name).write_bytes(data.draw(damaged((folder / name).read_bytes())))
    try:
        readers(folder)[name](tmp_path / name)
    except InputError as error:
        assert "\n" not in str(error) and name in str(error)


@pytest.mark.parametrize("name", ["volume.dcm", "masses.dcm", "surfaces.dcm", "report.dcm"])
def test_a_file_that_ends_early_is_refused(name, folder, tmp_path):
    whole = (folder / name).read_bytes()
    for share in (0.0, 0.02, 0.3, 0.7, 0.999):
        (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=name):
            readers(folder)[name](tmp_path / name)


def test_numbers_that_are_none_are_refused(folder, tmp_path):
    """As they stand in the file, which pydicom wouldn't write."""
    path = tmp_path / "masses.dcm"
    one = dcmread(folder / "masses.dcm")
    place = one.PerFrameFunctionalGroupsSequence[0].PlanePositionSequence[0].ImagePositionPatient[0]
    text = str(place.original_string).encode()
    path.write_bytes((folder / "masses.dcm").read_bytes().replace(text, b"nan".ljust(len(text)), 1))
    with pytest.raises(InputError, match="ImagePositionPatient: expected 3 finite numbers"):
        readers(folder)["masses.dcm"](path)


def test_implicit_types_are_read(folder, tmp_path):
    one = dcmread(folder / "volume.dcm")
    one.file_meta.TransferSyntaxUID = ImplicitVRLittleEndian
    one.save_as(tmp_path / "volume.dcm", implicit_vr=True, little_endian=True)
    assert (enhanced_volume.read(tmp_path / "volume.dcm").volume.voxels == made_results.volume().voxels).all()


def test_compressed_pixels_are_refused_with_a_way_on(folder, tmp_path):
    one = dcmread(folder / "volume.dcm")
    one.PixelData = encapsulate([b"\xff\x4f\xff\x51"] * one.NumberOfFrames)
    one.file_meta.TransferSyntaxUID = JPEG2000Lossless
    one.save_as(tmp_path / "volume.dcm")
    with pytest.raises(InputError, match=r"TransferSyntaxUID: expected uncompressed data.*JPEG 2000.*gdcmconv --raw"):
        enhanced_volume.read(tmp_path / "volume.dcm")


def test_a_small_file_that_unpacks_to_much_is_refused(tmp_path, folder):
    """Before it is unpacked: 64 MB of zeros are 64 kB where all is deflated (PS3.5, A.5)."""
    one = dcmread(folder / "report.dcm")
    one.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    one.save_as(path := tmp_path / "report.dcm")
    meta = path.read_bytes()[: 132 + 12 + one.file_meta.FileMetaInformationGroupLength]
    packed = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    path.write_bytes(meta + packed.compress(bytes(1 << 26)) + packed.flush())
    tracemalloc.start()
    with pytest.raises(InputError, match="TransferSyntaxUID: expected uncompressed data"):
        measurement_report.read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(path.read_bytes()) < 1 << 18 and peak < 1 << 22


def test_other_classes_are_refused(folder):
    with pytest.raises(InputError, match="SOPClassUID: expected Enhanced US Volume Storage, found Segmentation Storage"):
        received_file.read(folder / "masses.dcm", EnhancedUSVolumeStorage, "a volume")
    with pytest.raises(InputError, match="SOPClassUID: expected Comprehensive SR Storage"):
        received_file.read(folder / "report.dcm", ComprehensiveSRStorage, "a report")


def test_what_is_no_dicom_is_refused(tmp_path):
    (tmp_path / "a.dcm").write_bytes(b"x" * 1000)
    with pytest.raises(InputError, match=r"a\.dcm: expected a volume, found it damaged"):
        received_file.read(tmp_path / "a.dcm", EnhancedUSVolumeStorage, "a volume")
    with pytest.raises(InputError, match="found none"):
        received_file.read(tmp_path / "b.dcm", EnhancedUSVolumeStorage, "a volume")
