"""Open a clip of any kind: a folder of images, a video, or a DICOM file."""

from pathlib import Path

from recon.capture.images import image_files, read_grey
from recon.clips import dicom_clip, video_clip
from recon.clips.clip import Clip
from recon.errors import InputError


def read(path: Path) -> Clip:
    """Open a clip: a folder of images in natural order, a video by the ending of its name, else a DICOM file.

    Raises
    ------
    InputError
        If it is missing, damaged, or of another kind.
    """
    if path.is_dir():
        return _of_images(path)
    videos = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".wmv", ".webm")
    if path.suffix.lower() in videos:
        return video_clip.read(path)
    return dicom_clip.read(path)


def _of_images(folder: Path) -> Clip:
    """A folder of images, all of one size; it has no times."""
    paths = image_files(folder)
    if not paths:
        raise InputError(f"{folder}: expected images of a clip, found none")
    height, width = read_grey(paths[0]).shape
    return Clip(folder.name, (width, height), len(paths), None, lambda: (read_grey(path, (width, height)) for path in paths))
