"""Surfaces in DICOM: the same triangles to float32, the skin's errors along its rays, and files of others."""

import numpy as np
import pytest
import trimesh
from pydicom import dcmread

from recon.dicom import surface_segments
from recon.errors import InputError
from recon.geometry import rigid
from tests.recon.dicom import made_results


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    made_results.written(folder)
    return folder / "surfaces.dcm"


def test_reading_back_gives_the_same(path):
    found, given = surface_segments.read(path), made_results.results()
    meshes = {name: mass.mesh for name, mass in given.masses.items()} | {"skin": given.skin}
    assert list(found) == list(meshes)
    for name, mesh in meshes.items():
        expected = rigid.apply(made_results.SUPINE.patient_from_world, np.asarray(mesh.vertices))
        assert (found[name].faces == mesh.faces).all()
        assert np.abs(found[name].vertices - expected).max() < 1e-4  # float32 at 700 mm: 3e-5
        normals = rigid.rotate(made_results.SUPINE.patient_from_world, mesh.vertex_normals)
        assert np.abs(found[name].vertex_normals - normals).max() < 1e-6
        assert found[name].volume == pytest.approx(mesh.volume, rel=1e-4)  # turned, not mirrored: its sign stays


def test_closed_ones_are_called_closed(path):
    by_label = dict(zip(["mass0", "mass1", "skin"], dcmread(path).SurfaceSequence, strict=True))
    assert by_label["mass0"].FiniteVolume == "YES" and by_label["mass0"].Manifold == "YES"
    assert "PointPositionAccuracy" not in by_label["mass0"].SurfacePointsSequence[0]


def test_errors_of_the_skin_lie_along_its_rays(tmp_path):
    """A small patch straight ahead of the camera errs along z alone, one at 45 degrees as much along x; in the patient's axes."""
    found = made_results.results()
    for aside, expected in ((0.0, (0, 0.2, 0)), (600.0, (0.2 / 2**0.5, 0.2 / 2**0.5, 0))):
        skin = trimesh.creation.icosphere(1, 0.01).apply_translation([aside, 0, 600])
        skin.vertex_attributes["sigma_mm"] = np.full(len(skin.vertices), 0.2)
        made_results.written(tmp_path, found=type(found)(found.volume, {}, skin))
        (read,) = surface_segments.read(tmp_path / "surfaces.dcm").values()
        assert np.abs(read.metadata["accuracy_mm"] - expected).max() < 1e-4


def points_of(one):
    return one.SurfaceSequence[0].SurfacePointsSequence[0]


def corners_of(one):
    return one.SurfaceSequence[0].SurfaceMeshPrimitivesSequence[0]


def replaced(data: bytes, start: int, value: bytes) -> bytes:
    return data[:start] + value + data[start + len(value) :]


def put(item, name, start, value):
    setattr(item, name, replaced(getattr(item, name), start, value))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda one: put(points_of(one), "PointCoordinatesData", 24, np.float32(np.nan).tobytes()), "finite numbers below 1e"),
        (lambda one: put(points_of(one), "PointCoordinatesData", 24, np.float32(1e30).tobytes()), "finite numbers below 1e"),
        (lambda one: put(corners_of(one), "LongTrianglePointIndexList", 8, bytes(4)), "triangles of points 1 to 2562"),
        (lambda one: put(corners_of(one), "LongTrianglePointIndexList", 8, b"\xff" * 4), "triangles of points 1 to 2562"),
        (lambda one: setattr(points_of(one), "NumberOfSurfacePoints", 2 * 10**9), "2000000000 vectors of three float32"),
        (lambda one: setattr(one, "NumberOfSurfaces", 4), "NumberOfSurfaces: expected 3"),
        (lambda one: setattr(one.SegmentSequence[0].ReferencedSurfaceSequence[0], "ReferencedSurfaceNumber", 9), "one surface"),
        (lambda one: setattr(one, "FrameOfReferenceUID", "1.2.3"), "FrameOfReferenceUID: expected the volume's"),
        (lambda one: one.__delitem__("SurfaceSequence"), "found it damaged"),
    ],
)
def test_others_are_refused(change, said, path, tmp_path):
    one = dcmread(path)
    frame = one.FrameOfReferenceUID
    change(one)
    one.save_as(tmp_path / "surfaces.dcm")
    with pytest.raises(InputError, match=said) as refusal:
        surface_segments.read(tmp_path / "surfaces.dcm", frame)
    assert "\n" not in str(refusal.value)
