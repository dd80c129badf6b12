"""A compounded volume as Enhanced Ultrasound Volume: a frame a slice, placed in the world and in the patient.

The volume's frame of reference is the world, the frame of camera 1; the patient's is turned from it. Both are in mm, and each
frame's place stands in both. What a scanner knows and a compounded volume doesn't (indices of output, depth of focus) is 0, and a
remark in the file says so.

Source: DICOM PS3.3, A.59, C.8.24 and C.7.6.16.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.sr.coding import Code
from pydicom.tag import Tag
from pydicom.uid import EnhancedUSVolumeStorage

from recon.dicom import received_file
from recon.dicom.received_file import MOST_ITEMS, SAME_MM, fault, numbers
from recon.dicom.study_objects import NO_DATE, NO_TIME, OURS, Study, coded, decimals, item, own_scheme
from recon.errors import InputError
from recon.files.volumes import Volume
from recon.geometry import rigid

Array = NDArray[np.float64]

KIND = "an Enhanced Ultrasound Volume"
MOST_BYTES = (1 << 32) - 2  # of an element's value
IMAGE_TYPE = "ORIGINAL", "PRIMARY", "VOLUME", "NONE"
UNKNOWN = "Compounded from tracked B-scans: mechanical and thermal indices, focus and duration are not known and stand as 0."
SCAN_CODES = {  # of CID 12032 to 12035 and 12226
    "TransducerScanPatternCodeSequence": Code("125241", "DCM", "Plane scan pattern"),
    "TransducerGeometryCodeSequence": Code("125252", "DCM", "Linear ultrasound transducer geometry"),
    "TransducerBeamSteeringCodeSequence": Code("125257", "DCM", "Fixed beam direction"),
    "TransducerApplicationCodeSequence": Code("125261", "DCM", "External Transducer"),
    "ViewCodeSequence": Code("SN1", OURS, "Volume of a freehand sweep"),  # those of the standard are echocardiography's
}


@dataclass(frozen=True, eq=False)
class ReceivedVolume:
    """A volume that was read, in the patient's frame if the file has it."""

    volume: Volume
    frame_of_reference: str
    world_from_patient: Array  # (4, 4); the identity where the file has one frame only


def built(study: Study, volume: Volume, world_from_patient: Array) -> Dataset:
    """The object of a volume : voxels uint8 or uint16, in the patient's frame.

    Raises
    ------
    InputError
        If voxels are of another kind, or more than DICOM's length of an element counts.
    """
    voxels = volume.voxels
    if voxels.dtype not in (np.uint8, np.uint16) or voxels.nbytes > MOST_BYTES:
        expected = f"voxels of 8 or 16 bits without sign, up to {MOST_BYTES >> 20} MiB of them"
        way = "give a larger spacing_mm to freehand"
        raise InputError(f"volume: expected {expected}, found {voxels.dtype}, {voxels.nbytes >> 20} MiB; {way}")
    nz, ny, nx = voxels.shape
    bits = 8 * voxels.dtype.itemsize
    one = study.begun("volume", EnhancedUSVolumeStorage, "US", 1, "Compounded volume")
    moment = (study.patient.date or NO_DATE) + (study.patient.time or NO_TIME)
    one.ImageType, one.AcquisitionDateTime, one.AcquisitionDuration = [*IMAGE_TYPE], moment, 0.0
    one.Laterality, one.PatientOrientation = study.patient.laterality, ""
    one.UltrasoundAcquisitionGeometry, one.PatientFrameOfReferenceSource = "PATIENT", "ESTIMATED"
    one.VolumeFrameOfReferenceUID = study.uid("world")
    one.VolumeToTransducerRelationship = "VARIABLE"
    one.VolumeToTransducerMappingMatrix = np.eye(4).ravel().tolist()
    one.SynchronizationTrigger, one.AcquisitionTimeSynchronized = "NO TRIGGER", "N"
    one.SynchronizationFrameOfReferenceUID = study.uid("clock")
    one.AcquisitionContextSequence = []
    one.ImageComments, one.CodingSchemeIdentificationSequence = UNKNOWN, own_scheme()
    one.MechanicalIndex = one.BoneThermalIndex = one.CranialThermalIndex = one.SoftTissueThermalIndex = "0"
    one.DepthOfScanField, one.DepthsOfFocus = 0, [0.0]
    one.PositionMeasuringDeviceUsed = "FREEHAND"
    one.AnatomicRegionSequence = [coded(study.patient.region)]
    for name, code in SCAN_CODES.items():
        setattr(one, name, [coded(code)])

    one.SamplesPerPixel, one.PhotometricInterpretation, one.PixelRepresentation = 1, "MONOCHROME2", 0
    one.BitsAllocated, one.BitsStored, one.HighBit = bits, bits, bits - 1
    one.RescaleIntercept, one.RescaleSlope, one.PresentationLUTShape = "0", "1", "IDENTITY"
    one.BurnedInAnnotation, one.LossyImageCompression = "NO", "00"
    one.Rows, one.Columns, one.NumberOfFrames = ny, nx, nz
    organisation = study.uid("dimensions of volume")
    one.DimensionOrganizationType = "3D"
    one.DimensionOrganizationSequence = [item(DimensionOrganizationUID=organisation)]
    pointers = Tag("ImagePositionVolume"), Tag("PlanePositionVolumeSequence")
    one.DimensionIndexSequence = [
        item(DimensionOrganizationUID=organisation, DimensionIndexPointer=pointers[0], FunctionalGroupPointer=pointers[1])
    ]
    one.SharedFunctionalGroupsSequence = [_shared(volume, world_from_patient, bits)]
    one.PerFrameFunctionalGroupsSequence = [_frame(volume, world_from_patient, moment, k) for k in range(nz)]
    one.PixelData = _padded(voxels.astype(voxels.dtype.newbyteorder("<")).tobytes())
    one["PixelData"].VR = "OB" if bits == 8 else "OW"
    return one


def measures(volume: Volume) -> Dataset:
    """Distances of pixels and frames (PS3.3, C.7.6.16.2.1)."""
    x, y, z = decimals(volume.spacing)
    return item(PixelSpacing=[y, x], SliceThickness=z, SpacingBetweenSlices=z)


def orientation(volume: Volume) -> Dataset:
    """Directions of rows and columns in the patient."""
    return item(ImageOrientationPatient=decimals(volume.directions[:, :2].T.ravel()))


def position(volume: Volume, k: int) -> Dataset:
    """The place of a slice's first pixel in the patient."""
    return item(ImagePositionPatient=decimals(_corner(volume, k)))


def _corner(volume: Volume, k: int) -> Array:
    return volume.origin + volume.directions[:, 2] * volume.spacing[2] * k


def _shared(volume: Volume, world_from_patient: Array, bits: int) -> Dataset:
    across = (world_from_patient[:3, :3] @ volume.directions[:, :2]).T.ravel().tolist()
    middle = 2 ** (bits - 1)
    return item(
        PixelMeasuresSequence=[measures(volume)],
        PlaneOrientationSequence=[orientation(volume)],
        PlaneOrientationVolumeSequence=[item(ImageOrientationVolume=across)],
        FrameVOILUTSequence=[item(WindowCenter=str(middle), WindowWidth=str(2 * middle))],
        ImageDataTypeSequence=[item(DataType="TISSUE_INTENSITY", AliasedDataType="NO")],
        USImageDescriptionSequence=[
            item(
                FrameType=[*IMAGE_TYPE],
                VolumetricProperties="VOLUME",
                VolumeBasedCalculationTechnique="NONE",
            )
        ],
    )


def _frame(volume: Volume, world_from_patient: Array, moment: str, k: int) -> Dataset:
    in_world = rigid.apply(world_from_patient, _corner(volume, k)).tolist()
    content = item(FrameReferenceDateTime=moment, FrameAcquisitionDateTime=moment, FrameAcquisitionDuration=0.0)
    content.DimensionIndexValues = [k + 1]
    return item(
        FrameContentSequence=[content],
        PlanePositionSequence=[position(volume, k)],
        PlanePositionVolumeSequence=[item(ImagePositionVolume=in_world)],
    )


def _padded(data: bytes) -> bytes:
    return data + b"\0" * (len(data) % 2)


def read(path: Path) -> ReceivedVolume:
    """Read a volume of one moment, of grey levels.

    Raises
    ------
    InputError
        If the file is missing, damaged, compressed or of another class, has colours, other lengths than it says, places that are
        no numbers, or frames that aren't evenly apart.
    """
    one = received_file.read(path, EnhancedUSVolumeStorage, KIND)
    with received_file.refusing(path, KIND):
        voxels = _voxels(path, one)
        by_patient = _grid(path, one, ("PlaneOrientation", "ImageOrientationPatient"), ("PlanePosition", "ImagePositionPatient"))
        by_volume = _grid(
            path, one, ("PlaneOrientationVolume", "ImageOrientationVolume"), ("PlanePositionVolume", "ImagePositionVolume")
        )
        order, patient_from_voxel = by_patient or by_volume or _unplaced(path)
        world_from_patient = np.eye(4)
        if by_patient is not None and by_volume is not None:
            world_from_patient = by_volume[1] @ np.linalg.inv(patient_from_voxel)
            if (wrong := rigid.fault(world_from_patient)) is not None:
                raise fault(path, "ImagePositionVolume", "the grid of ImagePositionPatient, turned", wrong)
        axes = patient_from_voxel[:3, :3]
        spacing = np.linalg.norm(axes, axis=0)
        volume = Volume(voxels[order], patient_from_voxel[:3, 3], spacing, axes / spacing)
        return ReceivedVolume(volume, str(one.get("FrameOfReferenceUID", "")), world_from_patient)


def _unplaced(path: Path) -> tuple[NDArray[np.int64], Array]:
    raise fault(path, "PlanePositionVolumeSequence", "a place of each frame", "none")


def sizes(path: Path, one: Dataset) -> tuple[int, int, int]:
    """Frames, rows and columns, of which the file has a functional group each; InputError."""
    count, rows, columns = (int(one[name].value) for name in ("NumberOfFrames", "Rows", "Columns"))
    groups = len(one.PerFrameFunctionalGroupsSequence)
    if not 1 <= count <= MOST_ITEMS or count != groups or rows < 1 or columns < 1:
        raise fault(path, "NumberOfFrames", f"1 to {MOST_ITEMS}, of {groups} that are described", count)
    return count, rows, columns


def _voxels(path: Path, one: Dataset) -> NDArray:
    count, rows, columns = sizes(path, one)
    kind = str(one.PhotometricInterpretation), int(one.SamplesPerPixel), int(one.PixelRepresentation)
    bits = int(one.BitsAllocated)
    if kind != ("MONOCHROME2", 1, 0) or bits not in (8, 16):
        raise fault(path, "PhotometricInterpretation", "grey levels of 8 or 16 bits without sign", f"{kind}, {bits} bits")
    data, length = one.PixelData, count * rows * columns * bits // 8
    if len(data) not in (length, length + 1):
        raise fault(path, "PixelData", f"{length} bytes, of {count} frames of {columns}x{rows}", f"{len(data)}: cut short?")
    return np.frombuffer(data, f"<u{bits // 8}", count * rows * columns).reshape(count, rows, columns)


def _grid(path: Path, one: Dataset, across: tuple[str, str], at: tuple[str, str]) -> tuple[NDArray[np.int64], Array] | None:
    """Order of the frames and the matrix : (4, 4) from voxel to mm, by names of a group and a field; None without these."""
    shared = one.SharedFunctionalGroupsSequence[0]
    frames = one.PerFrameFunctionalGroupsSequence
    if f"{at[0]}Sequence" not in frames[0]:
        return None
    turned = numbers(path, across[1], shared[f"{across[0]}Sequence"][0][across[1]].value, 6).reshape(2, 3)
    if not np.allclose(turned @ turned.T, np.eye(2), atol=1e-3):
        raise fault(path, across[1], "two unit vectors at right angles", turned.ravel())
    y, x = numbers(path, "PixelSpacing", shared.PixelMeasuresSequence[0].PixelSpacing, 2)
    places = np.array([numbers(path, at[1], frame[f"{at[0]}Sequence"][0][at[1]].value, 3) for frame in frames])
    normal = np.cross(*turned)
    if len(places) == 1:
        between = float(
            shared.PixelMeasuresSequence[0].get("SpacingBetweenSlices") or shared.PixelMeasuresSequence[0].SliceThickness
        )
        order, step = np.zeros(1, int), between * normal
    else:
        order = np.arange(len(places))
        step = (places[-1] - places[0]) / (len(places) - 1)
        if step @ normal == 0 or not _even(places, step):  # frames in another order
            order = np.argsort(places @ normal, kind="stable")
            step = (places[order[-1]] - places[order[0]]) / (len(places) - 1)
    if not (x > 0 and y > 0 and abs(step @ normal) > SAME_MM):
        raise fault(path, at[1], "frames and pixels apart from each other", f"{x:g}, {y:g}, {abs(step @ normal):g} mm")
    if not _even(places[order], step) or np.linalg.norm(np.cross(step, normal)) * len(places) > SAME_MM:
        raise fault(path, at[1], f"frames one behind the other, evenly to {SAME_MM:g} mm", "others")
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([turned[0] * x, turned[1] * y, step])
    matrix[:3, 3] = places[order[0]]
    return order, matrix


def _even(places: Array, step: Array) -> bool:
    return bool((np.abs(places - places[0] - np.arange(len(places))[:, None] * step) < SAME_MM).all())
