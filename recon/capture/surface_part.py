"""The surface part of a capture: one camera's fringe sequence, with its patterns and calibration.

Everything is checked on load; a fault is an `InputError` of one line that names the file, what was expected and what was found.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from recon.capture import calibration_files
from recon.capture.images import Images, Size, natural_key, png_header, read_images, write_images
from recon.capture.manifest import MANIFEST, SCHEMA, Device, Manifest, SurfacePart, read_manifest, validated, write_manifest
from recon.errors import InputError
from recon.files import atomic
from recon.files.regular import read_bytes
from recon.model.calibration import Calibration
from recon.model.patterns import Patterns


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
    """Read a pattern sequence from a YAML file with the fields of `recon.model.patterns.Patterns`.

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
        calibration_files.write(temporary / "calibration" / "optics.yaml", optics)
        for camera, stack in images.items():
            write_images([temporary / path for path in paths[camera]], stack)
        write_manifest(temporary, manifest)


def _fitting_calibration(path: Path, camera: str, size: Size, patterns: Patterns) -> Calibration:
    optics = calibration_files.read(path, sizes={camera: size, "projector": patterns.projector_size})
    for name, wanted in ((camera, size), ("projector", patterns.projector_size)):
        if name not in optics.cameras:
            raise InputError(f"{path}: expected {name}, found {', '.join(optics.cameras)}")
        found = optics.cameras[name].size
        if found != wanted:
            raise InputError(f"{path}: expected {name} of {wanted[0]}x{wanted[1]} px, found {found[0]}x{found[1]}")
    return optics
