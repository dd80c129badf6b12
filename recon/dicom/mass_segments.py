"""Masses as a DICOM Segmentation on the grid of a volume: a segment a mass, of the slices that it lies in.

Source: DICOM PS3.3, A.51, C.8.20.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.sr.coding import Code
from pydicom.tag import Tag
from pydicom.uid import SegmentationStorage

from recon.dicom import enhanced_volume, received_file
from recon.dicom.enhanced_volume import ReceivedVolume
from recon.dicom.received_file import MOST_ITEMS, SAME_MM, fault, numbers
from recon.dicom.study_objects import Study, coded, described_mass, item, reference, series_of
from recon.errors import short
from recon.files.volumes import Volume
from recon.freehand.volume_compounding import Grid
from recon.geometry import rigid
from recon.segmentation import mass_surface
from recon.segmentation.mass_surface import Mass

Mask = NDArray[np.bool_]

KIND = "a Segmentation"
DERIVED = Code("113076", "DCM", "Segmentation")  # of CID 7203
SOURCE = Code("121322", "DCM", "Source image for image processing operation")  # of CID 7202


def rasterised(mesh: trimesh.Trimesh, volume: Volume) -> Mask:
    """Voxels : (nz, ny, nx) whose middles lie in a closed mesh."""
    size, far = np.array(volume.voxels.shape[::-1]), mass_surface.FAR_MM / volume.spacing
    voxel = rigid.apply(np.linalg.inv(volume.world_from_voxel), np.asarray(mesh.vertices))
    low, high = np.floor(voxel.min(axis=0) - far).astype(int) - 1, np.ceil(voxel.max(axis=0) + far).astype(int) + 2
    first, end = np.clip(low, 0, size), np.clip(high, 0, size)
    mask = np.zeros(volume.voxels.shape, bool)
    if (first < end).all():  # around all of the mesh, though the volume may end within it
        grid = Grid(tuple((high - low).tolist()), rigid.apply(volume.world_from_voxel, low), volume.spacing, volume.directions)
        inside = mass_surface.distances([Mass(mesh)], grid).voxels < 0
        mask[_box(first, end)] = inside[_box(first - low, end - low)]
    return mask


def _box(first: NDArray[np.int64], end: NDArray[np.int64]) -> tuple[slice, ...]:
    return tuple(slice(a, b) for a, b in zip(first[::-1], end[::-1], strict=True))


def built(study: Study, source: Dataset, volume: Volume, masks: Mapping[str, Mask]) -> Dataset:
    """The object of masks : (nz, ny, nx) by the masses' names, none of them empty, over the volume that the source holds."""
    _, ny, nx = volume.voxels.shape
    shown = [(number, k) for number, mask in enumerate(masks.values(), 1) for k in np.flatnonzero(mask.any(axis=(1, 2))).tolist()]
    one = study.begun("masses", SegmentationStorage, "SEG", 2, "Masses")
    one.ImageType = ["DERIVED", "PRIMARY"]
    one.ContentLabel, one.ContentDescription, one.ContentCreatorName = "MASSES", "Masses in tracked B-scans", ""
    one.SamplesPerPixel, one.PhotometricInterpretation, one.PixelRepresentation = 1, "MONOCHROME2", 0
    one.BitsAllocated, one.BitsStored, one.HighBit, one.LossyImageCompression = 1, 1, 0, "00"
    one.SegmentationType, one.SegmentsOverlap = "BINARY", "YES" if _overlap(masks) else "NO"
    one.SegmentSequence = [described_mass(study, number, name) for number, name in enumerate(masks, 1)]
    one.Rows, one.Columns, one.NumberOfFrames = ny, nx, len(shown)
    organisation = study.uid("dimensions of masses")
    one.DimensionOrganizationSequence = [item(DimensionOrganizationUID=organisation)]
    pairs = ("ReferencedSegmentNumber", "SegmentIdentificationSequence"), ("ImagePositionPatient", "PlanePositionSequence")
    one.DimensionIndexSequence = [
        item(DimensionOrganizationUID=organisation, DimensionIndexPointer=Tag(field), FunctionalGroupPointer=Tag(group))
        for field, group in pairs
    ]
    one.ReferencedSeriesSequence = [series_of(source)]
    one.SharedFunctionalGroupsSequence = [
        item(
            PixelMeasuresSequence=[enhanced_volume.measures(volume)],
            PlaneOrientationSequence=[enhanced_volume.orientation(volume)],
        )
    ]
    one.PerFrameFunctionalGroupsSequence = [_frame(source, volume, number, k) for number, k in shown]
    whole = np.concatenate([mask[mask.any(axis=(1, 2))].ravel() for mask in masks.values()])
    bits = np.packbits(whole, bitorder="little").tobytes()
    one.PixelData = bits + b"\0" * (len(bits) % 2)
    one["PixelData"].VR = "OB"
    return one


def _overlap(masks: Mapping[str, Mask]) -> bool:
    return bool((np.sum([mask.astype(np.uint8) for mask in masks.values()], axis=0) > 1).any())


def _frame(source: Dataset, volume: Volume, number: int, k: int) -> Dataset:
    image = reference(source)
    image.ReferencedFrameNumber, image.PurposeOfReferenceCodeSequence = k + 1, [coded(SOURCE)]
    image.SpatialLocationsPreserved = "YES"
    return item(
        DerivationImageSequence=[item(DerivationCodeSequence=[coded(DERIVED)], SourceImageSequence=[image])],
        FrameContentSequence=[item(DimensionIndexValues=[number, k + 1])],
        PlanePositionSequence=[enhanced_volume.position(volume, k)],
        SegmentIdentificationSequence=[item(ReferencedSegmentNumber=number)],
    )


def read(path: Path, over: ReceivedVolume) -> dict[str, Mask]:
    """Masks : (nz, ny, nx) by their labels, on the grid of a volume of the same frame of reference.

    Raises
    ------
    InputError
        If the file is missing, damaged, compressed or of another class, isn't of whole pixels, or lies on another grid.
    """
    one = received_file.read(path, SegmentationStorage, KIND)
    received_file.check_frame(path, one, over.frame_of_reference)
    with received_file.refusing(path, KIND):
        count, rows, columns = enhanced_volume.sizes(path, one)
        kind, bits = str(one.SegmentationType), int(one.BitsAllocated)
        if kind != "BINARY" or bits != 1:
            raise fault(path, "SegmentationType", "BINARY, of one bit", f"{kind}, of {bits}")
        shape = over.volume.voxels.shape
        if (rows, columns) != shape[1:]:
            raise fault(path, "Rows", f"{shape[2]}x{shape[1]}, as the volume has", f"{columns}x{rows}")
        length = (count * rows * columns + 7) // 8
        if len(one.PixelData) not in (length, length + 1):
            raise fault(path, "PixelData", f"{length} bytes, of {count} frames", f"{len(one.PixelData)}: cut short?")
        labels = _labels(path, one)
        needed = max(len(labels) * over.volume.voxels.size, count * rows * columns)
        if needed > received_file.MOST_BYTES:
            raise fault(
                path, "SegmentSequence", f"masks of up to {received_file.MOST_BYTES >> 30} GiB in memory", f"{needed} bytes"
            )
        frames = np.unpackbits(np.frombuffer(one.PixelData, np.uint8), bitorder="little")[: count * rows * columns]
        masks = {label: np.zeros(shape, bool) for label in labels.values()}
        shared = one.SharedFunctionalGroupsSequence[0]
        for frame, group in zip(frames.reshape(count, rows, columns), one.PerFrameFunctionalGroupsSequence, strict=True):
            number = int(group.SegmentIdentificationSequence[0].ReferencedSegmentNumber)
            if number not in labels:
                raise fault(path, "ReferencedSegmentNumber", f"one of {short(str(list(labels)))}", number)
            masks[labels[number]][_slice(path, shared, group, over.volume)] |= frame.astype(bool)
        return masks


def _labels(path: Path, one: Dataset) -> dict[int, str]:
    found = {int(segment.SegmentNumber): str(segment.SegmentLabel) for segment in one.SegmentSequence}
    if not 0 < len(one.SegmentSequence) <= MOST_ITEMS or len(set(found.values())) < len(one.SegmentSequence):
        raise fault(path, "SegmentSequence", "segments, each with a number and a label of its own", short(str(found)))
    return found


def _slice(path: Path, shared: Dataset, group: Dataset, volume: Volume) -> int:
    """The slice of the volume that a frame is of; InputError if it is none."""
    along = (group if "PlaneOrientationSequence" in group else shared).PlaneOrientationSequence[0].ImageOrientationPatient
    turned = numbers(path, "ImageOrientationPatient", along, 6)
    place = numbers(path, "ImagePositionPatient", group.PlanePositionSequence[0].ImagePositionPatient, 3)
    apart = (group if "PixelMeasuresSequence" in group else shared).PixelMeasuresSequence[0].PixelSpacing
    spacing = numbers(path, "PixelSpacing", apart, 2)[::-1]
    step = volume.directions[:, 2] * volume.spacing[2]
    k = round(float((place - volume.origin) @ step / (step @ step)))
    extent = np.array(volume.voxels.shape[:0:-1])
    off = (turned.reshape(2, 3).T * spacing - volume.directions[:, :2] * volume.spacing[:2]) * extent
    if not 0 <= k < len(volume.voxels) or max(np.abs(place - volume.origin - k * step).max(), np.abs(off).max()) > SAME_MM:
        raise fault(path, "ImagePositionPatient", f"frames on slices of the volume, to {SAME_MM:g} mm", place)
    return k
