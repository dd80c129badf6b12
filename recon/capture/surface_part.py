"""The surface part of a capture: one camera's fringe sequence, with its patterns and calibration.

Everything is checked on load; a fault is an `InputError` of one line that names the file, what was expected and what was found.
"""

from dataclasses import dataclass
from pathlib import Path

from recon.capture import calibration_files
from recon.capture.image_formats import decode_image
from recon.capture.images import Images, image_files, read_images
from recon.capture.manifest import MANIFEST, read_manifest
from recon.errors import InputError, validated
from recon.files import yaml_text
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
    device = manifest.devices_of("surface")[camera]
    sizes = {camera: device.size, "projector": manifest.surface.patterns.projector_size}
    optics = calibration_files.read_for(manifest.calibration_file(folder, calibration_file), sizes)
    root = folder / manifest.root
    images = read_images([root / path for path in manifest.surface.images[camera]], device.size, device.bits)
    return SurfaceCapture(images, manifest.surface.patterns, device.bits, optics, manifest.name_of(folder))


def cameras_beside(folder: Path, camera: str) -> list[str]:
    """Cameras besides this one that took the fringe sequence, in the manifest's order."""
    part = read_manifest(Path(folder)).surface
    return [] if part is None else [name for name in part.images if name != camera]


def read_bare(images_dir: Path, patterns: Patterns, calibration_file: Path, camera: str = "cam1") -> SurfaceCapture:
    """Read the images of a folder, in natural order (2.png before 10.png), with a calibration from elsewhere.

    8-bit images count as 8 bits; in 16-bit images the bits (10 or 12) follow from the largest value.

    Raises
    ------
    InputError
        As `read_surface`; also if the number of images differs from the number of patterns.
    """
    images_dir = Path(images_dir)
    if not images_dir.is_dir():
        raise InputError(f"{images_dir}: expected a folder of images, found {'a file' if images_dir.exists() else 'nothing'}")
    paths = image_files(images_dir)
    if len(paths) != patterns.count:
        raise InputError(f"{images_dir}: expected {patterns.count} images, one a pattern, found {len(paths)}")
    first = decode_image(paths[0], read_bytes(paths[0]))
    (height, width), deep = first.shape[:2], first.dtype.itemsize > 1
    optics = calibration_files.read_for(Path(calibration_file), {camera: (width, height), "projector": patterns.projector_size})
    images = read_images(paths, (width, height), 12 if deep else 8)
    bits = 8 if not deep else 10 if images.max() < 1 << 10 else 12
    return SurfaceCapture(images, patterns, bits, optics, images_dir.resolve().name)


def read_patterns(path: Path) -> Patterns:
    """Read a pattern sequence from a YAML file with the fields of `recon.model.patterns.Patterns`.

    Raises
    ------
    InputError
        If the file is missing, not YAML, or a field is wrong.
    """
    path = Path(path)
    return validated(Patterns, yaml_text.read(path), path)
