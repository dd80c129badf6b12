"""Skin and masses as a DICOM Surface Segmentation: triangles, each surface a segment.

Places are float32, which is 0.03 um at a metre. The standard deviation of the skin's points goes along, as one for each axis.

Source: DICOM PS3.3, A.57, C.8.23 and C.27.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.sr.coding import Code
from pydicom.uid import SurfaceSegmentationStorage

from recon.dicom import received_file
from recon.dicom.received_file import FARTHEST_MM, MOST_ITEMS, fault, numbers
from recon.dicom.study_objects import (
    MASS_FAMILY,
    OURS,
    Study,
    algorithm,
    coded,
    described_mass,
    item,
    own_scheme,
    reference,
    series_of,
)
from recon.errors import short
from recon.segmentation.mass_files import FoundMass

Array = NDArray[np.float64]

KIND = "a Surface Segmentation"
SKIN = "skin"
SKIN_CODE = Code("39937001", "SCT", "Skin")
TISSUE = Code("91723000", "SCT", "Anatomical Structure")
BY_LIGHT = Code("SN2", OURS, "Triangulation of projected fringes")


class Look(NamedTuple):
    """How a viewer is asked to show a surface."""

    lab: tuple[int, int, int]  # PS3.3, C.10.7.1.1: L* of 0 to 100, a* and b* of -128 to 127, as 0 to 65535
    grey: int
    opacity: float


SKIN_LOOK = Look((52428, 34952, 36751), 52428, 0.4)
MASS_LOOK = Look((35000, 50000, 45000), 35000, 1.0)


def built(study: Study, source: Dataset, masses: Mapping[str, FoundMass], skin: trimesh.Trimesh | None, camera: Array) -> Dataset:
    """The object of the masses' meshes, and the skin's, with the camera's centre : (3,) that errors of the skin point to."""
    one = study.begun("surfaces", SurfaceSegmentationStorage, "SEG", 3, "Skin and masses, surfaces")
    one.ContentLabel, one.ContentDescription, one.ContentCreatorName = "SURFACES", "Skin and masses", ""
    one.CodingSchemeIdentificationSequence = own_scheme()
    segments = [(described_mass(study, number, name), mass.mesh) for number, (name, mass) in enumerate(masses.items(), 1)]
    if skin is not None:
        segments.append((_described_skin(study, len(segments) + 1), skin))
    for number, (segment, _) in enumerate(segments, 1):
        verb, family = ("surface", BY_LIGHT) if segment.SegmentLabel == SKIN else ("segment", MASS_FAMILY)
        one_surface = item(
            ReferencedSurfaceNumber=number,
            SegmentSurfaceGenerationAlgorithmIdentificationSequence=[algorithm(verb, family)],
            SegmentSurfaceSourceInstanceSequence=[] if segment.SegmentLabel == SKIN else [reference(source)],
        )
        for name in ("SegmentAlgorithmName", "SegmentationAlgorithmIdentificationSequence"):  # each surface has its own
            segment.pop(name, None)
        segment.SurfaceCount, segment.ReferencedSurfaceSequence = 1, [one_surface]
    one.SegmentSequence = [segment for segment, _ in segments]
    one.NumberOfSurfaces = len(segments)
    one.SurfaceSequence = [
        _surface(number, mesh, SKIN_LOOK if segment.SegmentLabel == SKIN else MASS_LOOK, camera)
        for number, (segment, mesh) in enumerate(segments, 1)
    ]
    one.ReferencedSeriesSequence = [series_of(source)]
    return one


def _described_skin(study: Study, number: int) -> Dataset:
    return item(
        SegmentNumber=number,
        SegmentLabel=SKIN,
        SegmentDescription="Surface as measured by light",
        SegmentAlgorithmType="AUTOMATIC",
        SegmentedPropertyCategoryCodeSequence=[coded(TISSUE)],
        SegmentedPropertyTypeCodeSequence=[coded(SKIN_CODE)],
        AnatomicRegionSequence=[coded(study.patient.region)],
        TrackingID=SKIN,
        TrackingUID=study.uid(f"tracked {SKIN}"),
    )


def _surface(number: int, mesh: trimesh.Trimesh, look: Look, camera: Array) -> Dataset:
    vertices = np.asarray(mesh.vertices, "<f4")
    points = item(NumberOfSurfacePoints=len(vertices), PointCoordinatesData=vertices.tobytes())
    bounds = np.array([vertices.min(axis=0), vertices.max(axis=0)])
    points.PointsBoundingBoxCoordinates = bounds.ravel().tolist()
    if (accuracy := _accuracy(mesh, camera)) is not None:
        points.PointPositionAccuracy = accuracy.tolist()
    normals = np.asarray(mesh.vertex_normals, "<f4")
    corners = np.asarray(mesh.faces, "<u4").ravel() + 1
    closed = bool(mesh.is_watertight)
    return item(
        SurfaceNumber=number,
        SurfaceProcessing="NO",
        RecommendedDisplayGrayscaleValue=look.grey,
        RecommendedDisplayCIELabValue=list(look.lab),
        RecommendedPresentationOpacity=look.opacity,
        RecommendedPresentationType="SURFACE",
        FiniteVolume="YES" if closed else "NO",
        Manifold="YES" if closed else "UNKNOWN",
        SurfacePointsSequence=[points],
        SurfacePointsNormalsSequence=[
            item(NumberOfVectors=len(normals), VectorDimensionality=3, VectorCoordinateData=normals.tobytes())
        ],
        SurfaceMeshPrimitivesSequence=[
            item(
                LongVertexPointIndexList=None,
                LongEdgePointIndexList=None,
                LongTrianglePointIndexList=corners.tobytes(),
                TriangleStripSequence=[],
                TriangleFanSequence=[],
                LineSequence=[],
                FacetSequence=[],
            )
        ],
    )


def _accuracy(mesh: trimesh.Trimesh, camera: Array) -> Array | None:
    """Standard deviations : (3,) mm of all points along each axis, of those along their rays; None where these aren't known."""
    sigma = np.asarray(mesh.vertex_attributes.get("sigma_mm", np.nan), float).ravel()
    if not np.isfinite(sigma).any():
        return None
    rays = np.asarray(mesh.vertices) - camera
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.sqrt(np.nanmean((sigma[:, None] * rays) ** 2, axis=0))


def read(path: Path, frame_of_reference: str | None = None) -> dict[str, trimesh.Trimesh]:
    """Surfaces by the labels of their segments, in mm in the patient's frame; with `accuracy_mm` : (3,) in `metadata` if known.

    frame_of_reference : that these must be in; None takes any

    Raises
    ------
    InputError
        If the file is missing, damaged, compressed or of another class, lies in another frame, has no triangles, or places that
        are no numbers.
    """
    one = received_file.read(path, SurfaceSegmentationStorage, KIND)
    received_file.check_frame(path, one, frame_of_reference)
    with received_file.refusing(path, KIND):
        surfaces = {int(surface.SurfaceNumber): surface for surface in one.SurfaceSequence}
        if not 0 < len(surfaces) <= MOST_ITEMS or int(one.NumberOfSurfaces) != len(one.SurfaceSequence):
            raise fault(path, "NumberOfSurfaces", f"{len(one.SurfaceSequence)}, which are there", one.NumberOfSurfaces)
        meshes = dict[str, trimesh.Trimesh]()
        for segment in one.SegmentSequence:
            label, parts = str(segment.SegmentLabel), segment.ReferencedSurfaceSequence
            number = int(parts[0].ReferencedSurfaceNumber) if len(parts) == 1 else 0
            if label in meshes or number not in surfaces:
                raise fault(path, "ReferencedSurfaceNumber", f"one surface of a segment, of {short(str(list(surfaces)))}", number)
            meshes[label] = _mesh(path, surfaces[number])
        return meshes


def _mesh(path: Path, surface: Dataset) -> trimesh.Trimesh:
    points, primitives = surface.SurfacePointsSequence[0], surface.SurfaceMeshPrimitivesSequence[0]
    vertices = _floats(path, "PointCoordinatesData", points.PointCoordinatesData, int(points.NumberOfSurfacePoints))
    listed = primitives.get("LongTrianglePointIndexList") or b""
    old = primitives.get("TrianglePointIndexList") or b""  # of 16 bits, retired
    corners = np.frombuffer(listed, "<u4") if listed else np.frombuffer(old, "<u2")
    if not len(corners) or len(corners) % 3 or corners.min() < 1 or corners.max() > len(vertices):
        raise fault(path, "LongTrianglePointIndexList", f"triangles of points 1 to {len(vertices)}", f"{len(corners)} numbers")
    given = surface.get("SurfacePointsNormalsSequence") or []
    normals = None
    if given and int(given[0].VectorDimensionality) == 3 and int(given[0].NumberOfVectors) == len(vertices):
        normals = _floats(path, "VectorCoordinateData", given[0].VectorCoordinateData, len(vertices))
    faces = corners.reshape(-1, 3).astype(np.int64) - 1
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False, validate=False)
    if accuracy := points.get("PointPositionAccuracy"):
        mesh.metadata["accuracy_mm"] = numbers(path, "PointPositionAccuracy", accuracy, 3)
    return mesh


def _floats(path: Path, field: str, data: bytes, count: int) -> Array:
    """Vectors : (count, 3) of a field; InputError if these are others or no numbers."""
    if len(data) != 12 * count:
        raise fault(path, field, f"{count} vectors of three float32", f"{len(data)} bytes")
    values = np.frombuffer(data, "<f4").reshape(count, 3).astype(float)
    if not (np.abs(values) < FARTHEST_MM).all():
        raise fault(path, field, f"finite numbers below {FARTHEST_MM:g}", values[~(np.abs(values) < FARTHEST_MM)][0])
    return values
