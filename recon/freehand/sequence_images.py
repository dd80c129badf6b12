"""Images of a PLUS sequence: their number and size, and their pixels as 8-bit grey levels, depth down.

PLUS names an image's orientation by the directions of the transducer in which x and y grow: M towards the marked side of its
array, U away from it, F away from its face, N towards it. It turns B-scans to MF when it reads them, so its frame `Image` is that
of images so turned, and so is ours.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.files import medical_images
from recon.files.medical_images import ImageFile

TURNS = {"MF": (1, 1), "UF": (1, -1), "MN": (-1, 1), "UN": (-1, -1)}  # steps along v and u that turn one into MF
ORIENTATIONS = (*TURNS, *(name[::-1] for name in TURNS))  # those with lines of sound in rows are transposed before
LUMINANCE = np.array([299, 587, 114])  # of red, green and blue, per mille: Rec. ITU-R BT.601
DEPTHS = (8, 10, 12, 14, 16)  # bits of scanners' grey levels


class Layout(NamedTuple):
    """Images as a file has them."""

    count: int
    shape: tuple[int, int]  # rows and columns
    channels: int  # 1 of grey images, 3 or 4 of coloured ones


def layout(file: ImageFile) -> Layout:
    """Number and size of the images. Without kinds of its axes two are those of one image, and the last of more is time.

    Raises
    ------
    InputError
        If the axes are others.
    """
    kinds = file.fields.get("Kinds", file.fields.get("kinds", "")).split()
    kinds = kinds or ["domain"] * max(len(file.size) - 1, 2) + ["list"] * (len(file.size) > 2)
    if len(kinds) != len(file.size):
        raise file.fault("Kinds", f"{len(file.size)} words", repr(" ".join(kinds)))
    lengths = list(zip(file.size, (kind.lower() for kind in kinds), strict=True))
    colour_kinds = ("vector", "rgb-color", "rgba-color", "3-color", "4-color")  # of an NRRD axis
    colours = [length for length, kind in lengths[:1] if kind in colour_kinds]
    space = [length for length, kind in lengths if kind in ("domain", "space")]
    time = [length for length, kind in lengths if kind in ("list", "time")]
    strange = len(colours) + len(space) + len(time) < len(lengths)
    if strange or len(time) > 1 or len(space) not in (2, 3) or max(space[2:], default=1) > 1:
        raise file.fault("DimSize", "width, height and the number of frames", f"{' '.join(map(str, file.size))}")
    return Layout(time[0] if time else 1, (space[1], space[0]), colours[0] if colours else file.channels)


def has_images(file: ImageFile) -> bool:
    """Whether there are images: tracking alone is written with ones of no pixels, or of one and without their status."""
    rows, columns = layout(file).shape
    status = any(re.fullmatch(r"Seq_Frame\d+_(Image)?Status", name) for name in file.fields)
    return rows * columns > 1 or (rows * columns == 1 and status and file.pixel.itemsize > 0)


def turned_shape(file: ImageFile) -> tuple[int, int]:
    """Height and width of the images as `images` gives them."""
    shape = layout(file).shape
    return shape if _orientation(file) in TURNS else shape[::-1]


def images(file: ImageFile) -> Iterator[NDArray[np.uint8]]:
    """The images (h, w), one by one.

    Colours become their luminance. Of 16-bit levels the upper eight bits are taken, of as many as the greatest of the file needs:
    8, 10, 12, 14 or 16. Floating-point levels are rounded, after the same scale, or after one of 255 if none exceeds 1. For both
    the pixels are read twice.

    Raises
    ------
    InputError
        If the data ends early, or isn't grey or coloured levels from 0 on, such as radio-frequency data.
    """
    _, shape, channels = layout(file)
    orientation = _orientation(file)
    _check_levels(file, channels)
    most = _greatest(file)
    spare = next(bits for bits in DEPTHS if most < 1 << bits) - 8
    scale = 255.0 if most <= 1 else 0.5**spare
    for block in medical_images.blocks(file, shape[0] * shape[1] * channels * file.pixel.itemsize):
        stored = np.frombuffer(block, file.pixel).reshape(*shape, channels)
        levels = np.minimum(np.rint(stored * scale), 255).astype(np.int64) if file.pixel.kind == "f" else stored >> spare
        grey = levels[..., 0] if channels == 1 else (levels[..., :3] @ LUMINANCE + 500) // 1000
        yield _turned(grey.astype(np.uint8, copy=False), orientation)


def _turned(image: NDArray[np.uint8], orientation: str) -> NDArray[np.uint8]:
    """An image turned to MF."""
    if orientation not in TURNS:
        return _turned(image.T, orientation[::-1])
    down, right = TURNS[orientation]
    return image[::down, ::right]


def _orientation(file: ImageFile) -> str:
    """Directions of x and y; a third letter, of 3-D probes, is that across the image plane."""
    found = file.fields.get("UltrasoundImageOrientation", file.fields.get("ultrasound image orientation", "MF"))
    if found[:2] not in ORIENTATIONS:
        raise file.fault("UltrasoundImageOrientation", f"one of {', '.join(ORIENTATIONS)}", found)
    return found[:2]


def _check_levels(file: ImageFile, channels: int) -> None:
    found = file.fields.get("UltrasoundImageType", file.fields.get("ultrasound image type", "BRIGHTNESS"))
    if found.upper().startswith("RF"):
        raise file.fault("UltrasoundImageType", "BRIGHTNESS or RGB_COLOR", f"{found}, no images but radio-frequency data")
    if file.pixel.newbyteorder("=") not in (np.uint8, np.uint16, np.int16, np.float32, np.float64):
        field = "ElementType" if "ElementType" in file.fields else "type"
        raise file.fault(field, "grey levels of 8 or 16 bits, or floating-point ones", file.fields[field])
    if channels not in (1, 3, 4):
        raise file.fault("ElementNumberOfChannels", "1, 3 or 4", channels)


def _greatest(file: ImageFile) -> float:
    """The greatest level of all images, 255 where no more is possible."""
    if file.pixel == np.uint8:
        return 255
    least, most = 0.0, 0.0
    _, (rows, columns), channels = layout(file)
    for block in medical_images.blocks(file, rows * columns * channels * file.pixel.itemsize):
        levels = np.frombuffer(block, file.pixel)
        least, most = float(np.fmin(least, levels.min())), float(np.maximum(most, levels.max()))
    if least < 0:
        raise file.fault("pixels", "grey levels from 0 on", f"{least:g}: radio-frequency data?")
    if not most < 1 << DEPTHS[-1]:
        raise file.fault("pixels", f"grey levels below {1 << DEPTHS[-1]}", f"{most:g}")
    return most
