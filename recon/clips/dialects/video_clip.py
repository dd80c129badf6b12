"""Videos of a scanner's screen, by OpenCV."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture.image_formats import MOST_PX
from recon.clips.clip import Clip, checked_seconds
from recon.errors import InputError
from recon.files import video_file
from recon.files.regular import check_there

ENDS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".wmv", ".webm")
LEAST_STEP_S = 1e-6  # between frames' time stamps; without them all are 0


def recognises(path: Path) -> bool:
    """Whether its name ends as a video's."""
    return not path.is_dir() and path.suffix.lower() in ENDS


def read(path: Path) -> Clip:
    """Open a video; its time stamps are those of its frames, or even by its rate where it has none.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    check_there([path])
    frames = [(stamp, image.shape[1::-1], rate) for stamp, image, rate in _frames(path)]
    if not frames:
        raise InputError(f"{path}: expected a video, found none that OpenCV can read")
    stamps, sizes, rates = zip(*frames, strict=True)
    seconds, rate = np.array(stamps), rates[0]
    if len(seconds) > 1 and np.diff(seconds).min() < LEAST_STEP_S:
        seconds = np.arange(len(seconds)) / rate if rate > 0 else None
    timed = None if seconds is None else checked_seconds(path, seconds)
    return Clip(path.name, sizes[0], len(frames), timed, lambda: _images(path))


def _images(path: Path) -> Iterator[NDArray[np.uint8]]:
    return (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for _, image, _ in _frames(path))


def _frames(path: Path) -> Iterator[tuple[float, NDArray[np.uint8], float]]:
    """Time stamp in s, image : (h, w, 3) and the video's rate in frames/s, of each frame."""
    video = video_file.opened(path)
    try:
        width, height = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if not width * height <= MOST_PX:
            raise InputError(f"{path}: expected a video of up to {MOST_PX} px, found {width:g}x{height:g}")
        rate = float(video.get(cv2.CAP_PROP_FPS))
        while True:
            good, image = video.read()
            if not good:
                return
            yield float(video.get(cv2.CAP_PROP_POS_MSEC)) / 1e3, np.asarray(image, np.uint8), rate  # of the frame just read
    finally:
        video.release()
