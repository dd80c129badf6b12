"""A folder of images, in natural order."""

from pathlib import Path

from recon.capture.images import image_files, read_grey
from recon.clips.clip import Clip
from recon.errors import InputError


def recognises(path: Path) -> bool:
    """Whether it is a folder."""
    return path.is_dir()


def read(folder: Path) -> Clip:
    """Its images, all of one size; it has no times."""
    paths = image_files(folder)
    if not paths:
        raise InputError(f"{folder}: expected images of a clip, found none")
    height, width = read_grey(paths[0]).shape
    return Clip(folder.name, (width, height), len(paths), None, lambda: (read_grey(path, (width, height)) for path in paths))
