"""Open a clip of any dialect, a module of `dialects` each: a folder of images, a video, or a DICOM file."""

from pathlib import Path

from recon import registry
from recon.clips.clip import Clip
from recon.clips.dialects import dicom_clip
from recon.errors import InputError

DIALECTS = "recon.clips.dialects"  # a module each


def read(path: Path) -> Clip:
    """Open a clip of the dialect that recognises it, else a DICOM file.

    Raises
    ------
    InputError
        If it is missing, damaged, or of another dialect, or of two.
    """
    known = {name: dialect for name, dialect in registry.kinds(DIALECTS).items() if dialect.recognises(path)}
    if len(known) > 1:
        raise InputError(f"{path}: expected a clip of one dialect, found {' and '.join(known)}")
    return next(iter(known.values()), dicom_clip).read(path)
