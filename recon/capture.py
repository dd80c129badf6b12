"""Captures: the folder that devices or the twin write and the pipeline reads; its images, and its surface part.

Everything is checked on load; a fault is an `InputError` of one line that names the file, what was expected and what was found.
"""

import os
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from recon import atomic, calibration
from recon.calibration import Calibration
from recon.errors import InputError
from recon.manifest import MANIFEST, SCHEMA, Device, Manifest, SurfacePart, read_bytes, read_manifest, validated, write_manifest
from recon.patterns import Patterns

Images = NDArray[np.uint8] | NDArray[np.uint16]
Size = tuple[int, int]  # width, height, px

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_COLOURS = {0: "grey", 2: "colour", 3: "palette", 4: "grey with alpha", 6: "colour with alpha"}
PNG_COMPRESSION = 1  # sensor noise hardly compresses: higher levels cost time and save a few percent


@dataclass(frozen=True)
class SurfaceCapture:
    """One camera's view of a fringe sequence, checked."""

    images: Images  # (n, h, w), digital numbers
    patterns: Patterns
    bits: int
    calibration: Calibration
    name: str


def read_surface(folder: Path, camera: str = "cam1", calibration_file: Path | None = None) -> SurfaceCapture:
    """Read one camera's fringe sequence from a capture folder, with a calibration from elsewhere if one is given.

    Raises
    ------
    InputError
        If the manifest, the calibration or an image is missing, damaged or doesn't fit the others.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    if manifest.surface is None or camera not in manifest.surface.images:
        found = ", ".join(manifest.surface.images) if manifest.surface else "no surface part"
        raise InputError(f"{folder / MANIFEST}: expected surface images of {camera}, found {found or 'none'}")
    if calibration_file is None and manifest.calibration is None:
        raise InputError(f"{folder / MANIFEST}: expected calibration, the path of a calibration file, found none")
    device = manifest.devices[camera]
    source = Path(calibration_file or folder / str(manifest.calibration))
    optics = _fitting_calibration(source, camera, device.size, manifest.surface.patterns)
    root = folder / manifest.root
    images = read_images([root / path for path in manifest.surface.images[camera]], device.size, device.bits)
    return SurfaceCapture(images, manifest.surface.patterns, device.bits, optics, manifest.name or folder.resolve().name)


def read_bare(images_dir: Path, patterns_file: Path, calibration_file: Path, camera: str = "cam1") -> SurfaceCapture:
    """Read the PNG images of a folder, in natural order (2.png before 10.png), with patterns and calibration from elsewhere.

    8-bit images count as 8 bits; in 16-bit images the bits (10 or 12) follow from the largest value.

    Raises
    ------
    InputError
        As `read_surface`; also if the number of images differs from the number of patterns.
    """
    images_dir = Path(images_dir)
    patterns = read_patterns(patterns_file)
    if not images_dir.is_dir():
        raise InputError(f"{images_dir}: expected a folder of PNG images, found {'a file' if images_dir.exists() else 'nothing'}")
    paths = sorted((path for path in images_dir.iterdir() if path.suffix.lower() == ".png"), key=natural_key)
    if len(paths) != patterns.count:
        raise InputError(
            f"{images_dir}: expected {patterns.count} PNG images, one a pattern of {patterns_file}, found {len(paths)}"
        )
    width, height, depth, _ = png_header(paths[0], read_bytes(paths[0]))
    optics = _fitting_calibration(Path(calibration_file), camera, (width, height), patterns)
    images = read_images(paths, (width, height), 12 if depth == 16 else 8)
    bits = 8 if depth != 16 else 10 if images.max() < 1 << 10 else 12
    return SurfaceCapture(images, patterns, bits, optics, images_dir.resolve().name)


def read_patterns(path: Path) -> Patterns:
    """Read a pattern sequence from a YAML file with the fields of `recon.patterns.Patterns`.

    Raises
    ------
    InputError
        If the file is missing, not YAML, or a field is wrong.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(read_bytes(path))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected YAML, found {' '.join(str(error).split())}") from None
    except RecursionError:
        raise InputError(f"{path}: expected YAML, found values nested too deeply") from None
    return validated(Patterns, content, path)


def write_surface(
    folder: Path,
    images: Mapping[str, Images],
    patterns: Patterns,
    optics: Calibration,
    devices: Mapping[str, Device],
    name: str = "",
) -> None:
    """Write a capture folder with a surface part, whole or not at all, the same bytes for the same input.

    Parameters
    ----------
    images : camera name -> (n, h, w) uint8 or uint16
        One image a pattern; 16-bit where the device has more than 8 bits.

    Raises
    ------
    InputError
        If the place is taken by something that is not a capture, or can't be written to.
    ValueError
        If images, patterns and devices don't fit together.
    """
    paths = {camera: tuple(f"surface/{camera}/{i:04d}.png" for i in range(len(stack))) for camera, stack in images.items()}
    manifest = Manifest(
        schema=SCHEMA,
        name=name,
        devices=dict(devices),
        calibration="calibration/optics.yaml",
        surface=SurfacePart(patterns=patterns, images=paths),
    )
    for camera, stack in images.items():
        width, height = devices[camera].size
        dtype = np.uint8 if devices[camera].bits == 8 else np.uint16
        if stack.shape[1:] != (height, width) or stack.dtype != dtype:
            raise ValueError(f"images of {camera}: expected {width}x{height} {dtype.__name__}, found {stack.shape} {stack.dtype}")
    with atomic.new_folder(folder, MANIFEST) as temporary:
        (temporary / "calibration").mkdir()
        calibration.write(temporary / "calibration" / "optics.yaml", optics)
        for camera, stack in images.items():
            write_images([temporary / path for path in paths[camera]], stack)
        write_manifest(temporary, manifest)


def write_images(paths: Sequence[Path], images: Images) -> None:
    """Write grey PNG images : (n, h, w), making the folders.

    Raises
    ------
    OSError
        If one can't be encoded or written.
    """
    for folder in {path.parent for path in paths}:
        folder.mkdir(parents=True, exist_ok=True)

    def write(path: Path, image: Images) -> None:
        encoded, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])
        if not encoded:
            raise OSError(f"{path}: the PNG encoder failed")
        path.write_bytes(data.tobytes())

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(write, paths, images))


def read_images(paths: Sequence[Path], size: Size, bits: int) -> Images:
    """Read grey PNG images of one size : (n, h, w), uint8 for 8 bits and uint16 above.

    Raises
    ------
    InputError
        If one is missing, cut short, damaged, coloured, of another size or depth, or brighter than its bits allow.
    """
    images = np.empty((len(paths), size[1], size[0]), np.uint8 if bits == 8 else np.uint16)

    def read(i: int) -> None:
        images[i] = read_image(paths[i], size, bits)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(read, range(len(paths))))
    return images


def read_image(path: Path, size: Size, bits: int) -> Images:
    """Read one grey PNG image : (h, w); see `read_images`."""
    data = read_bytes(path)
    width, height, depth, colour = png_header(path, data)
    stored = 8 if bits == 8 else 16
    if (width, height) != size or depth != stored or colour != "grey":
        raise InputError(f"{path}: expected {size[0]}x{size[1]} {stored}-bit grey, found {width}x{height} {depth}-bit {colour}")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (height, width):
        raise InputError(f"{path}: expected a whole grey PNG image, found damaged data")
    if bits > 8 and (brightest := int(image.max())) >= 1 << bits:
        raise InputError(f"{path}: expected {bits}-bit values up to {(1 << bits) - 1}, right-aligned, found {brightest}")
    return image


def image_size(path: Path) -> Size:
    """Width and height of a PNG file, in px; checked as in `png_header`."""
    return png_header(path, read_bytes(path))[:2]


def png_header(path: Path, data: bytes) -> tuple[int, int, int, str]:
    """Width, height, bit depth and colour of a PNG file whose every chunk is whole.

    Versions of OpenCV return an image, partly black, for a file that was cut short; so the chunks and their checksums are
    checked here.

    Raises
    ------
    InputError
        If the data is no PNG, cut short, or a checksum doesn't fit.
    """
    if not data.startswith(PNG_SIGNATURE):
        raise InputError(f"{path}: expected a PNG image, found {'an empty file' if not data else 'other data'}")
    view, position, kind = memoryview(data), len(PNG_SIGNATURE), b""
    while kind != b"IEND":
        if position + 12 > len(data):
            raise InputError(f"{path}: expected a whole PNG image, found it cut short at {len(data)} bytes")
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            raise InputError(f"{path}: expected a whole PNG image, found it cut short at {len(data)} bytes")
        if zlib.crc32(view[position + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise InputError(f"{path}: expected a whole PNG image, found damaged data at byte {position}")
        position = end + 4
    if data[12:16] != b"IHDR":
        raise InputError(f"{path}: expected a PNG image, found no header in it")
    width, height, depth, colour = struct.unpack_from(">IIBB", data, len(PNG_SIGNATURE) + 8)
    return width, height, depth, PNG_COLOURS.get(colour, f"colour type {colour}")


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Key that sorts names as people do: 2.png before 10.png."""
    return [(int(piece), "") if piece.isdigit() else (-1, piece) for piece in re.split(r"(\d+)", Path(path).name)]


def _fitting_calibration(path: Path, camera: str, size: Size, patterns: Patterns) -> Calibration:
    optics = calibration.read(path, sizes={camera: size, "projector": patterns.projector_size})
    for name, wanted in ((camera, size), ("projector", patterns.projector_size)):
        if name not in optics.cameras:
            raise InputError(f"{path}: expected {name}, found {', '.join(optics.cameras)}")
        found = optics.cameras[name].size
        if found != wanted:
            raise InputError(f"{path}: expected {name} of {wanted[0]}x{wanted[1]} px, found {found[0]}x{found[1]}")
    return optics
