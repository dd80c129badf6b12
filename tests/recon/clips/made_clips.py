"""Clips as scanners leave them, made by the tests: B-scans of noise in a screen with a frame, a clock and a patient's name."""

from pathlib import Path

import cv2
import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from pydicom import dcmread
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.sequence import Sequence
from pydicom.uid import UID, ExplicitVRLittleEndian, UltrasoundMultiFrameImageStorage, generate_uid

BOX = (40, 30, 120, 96)  # u, v, width, height of the B-scan in the screen
SCREEN = (240, 160)


def scans(count: int, size: tuple[int, int] = BOX[2:], seed: int = 0) -> NDArray[np.uint8]:
    """B-scans : (n, h, w): speckle that changes from frame to frame."""
    noise = np.random.default_rng(seed).rayleigh(40.0, (count, *size[::-1]))
    return np.clip(noise, 0, 255).astype(np.uint8)


def screens(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same in a screen : (n, h, w), with what doesn't change, and a clock that does."""
    u, v, width, height = BOX
    shown = np.zeros((len(images), *SCREEN[::-1]), np.uint8)
    for number, (screen, image) in enumerate(zip(shown, images, strict=True)):
        cv2.putText(screen, "NAME", (5, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 200)
        cv2.putText(screen, f"{number:04d}", (180, 150), cv2.FONT_HERSHEY_SIMPLEX, 0.4, 200)
        screen[v : v + height, u : u + width] = image
        cv2.rectangle(screen, (u - 3, v - 3), (u + width + 2, v + height + 2), 90)
    return shown


def write_dicom(path: Path, frames: NDArray, region: bool = True, **tags: object) -> None:
    """A multi-frame file of frames : (n, h, w) grey or (n, h, w, 3) RGB, 8 or 16 bits."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.TransferSyntaxUID = UltrasoundMultiFrameImageStorage, ExplicitVRLittleEndian
    meta.MediaStorageSOPInstanceUID = generate_uid(entropy_srcs=["clip"])  # the same each time
    made = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    made.SOPClassUID, made.SOPInstanceUID, made.Modality = UltrasoundMultiFrameImageStorage, meta.MediaStorageSOPInstanceUID, "US"
    bits = 8 * frames.dtype.itemsize
    made.NumberOfFrames, made.Rows, made.Columns = frames.shape[:3]
    made.SamplesPerPixel = 3 if frames.ndim == 4 else 1
    made.PhotometricInterpretation = "RGB" if frames.ndim == 4 else "MONOCHROME2"
    made.BitsAllocated = made.BitsStored = bits
    made.HighBit, made.PixelRepresentation = bits - 1, 0
    if frames.ndim == 4:
        made.PlanarConfiguration = 0
    if region:
        made.SequenceOfUltrasoundRegions = Sequence([region_of((2, 2, 20, 8), 5, 1), region_of(BOX, 1, 1), region_of(BOX, 2, 1)])
    for name, value in tags.items():
        setattr(made, name, value)
    made.PixelData = frames.tobytes()
    made.save_as(path, enforce_file_format=True)


def compress(path: Path, encoded: list[bytes], syntax: UID) -> None:
    """Put frames that are encoded in the place of those of a file."""
    read = dcmread(path)
    read.PixelData = encapsulate(encoded)
    read["PixelData"].is_undefined_length = True
    read.file_meta.TransferSyntaxUID = syntax
    read.save_as(path)


def lossless_jpeg(path: Path, frame: NDArray) -> bytes:
    """A frame : (h, w) or (h, w, 3) as lossless JPEG, encoded by GDCM by way of a file."""
    writer = sitk.ImageFileWriter()
    writer.SetImageIO("GDCMImageIO")
    writer.SetUseCompression(True)
    writer.SetCompressor("JPEG")
    writer.SetFileName(path)
    writer.Execute(sitk.GetImageFromArray(frame[None], isVector=frame.ndim == 3))
    return next(generate_frames(dcmread(path).PixelData, number_of_frames=1))


def region_of(box: tuple[int, int, int, int], form: int, kind: int) -> Dataset:
    """An ultrasound region, of 0.0125 cm/px across and 0.0125 down; form 1 is two-dimensional, kind 1 tissue."""
    one = Dataset()
    one.RegionSpatialFormat, one.RegionDataType, one.RegionFlags = form, kind, 0
    one.RegionLocationMinX0, one.RegionLocationMinY0 = box[:2]
    one.RegionLocationMaxX1, one.RegionLocationMaxY1 = box[0] + box[2] - 1, box[1] + box[3] - 1
    one.PhysicalUnitsXDirection = one.PhysicalUnitsYDirection = 3
    one.PhysicalDeltaX, one.PhysicalDeltaY = 0.0125, 0.0119
    return one


def write_video(path: Path, frames: NDArray[np.uint8], rate_hz: float = 20.0) -> None:
    """An AVI of Motion JPEG."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, frames.shape[:0:-1])
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
