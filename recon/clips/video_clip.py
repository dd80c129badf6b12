"""Videos of a scanner's screen, by OpenCV."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture.image_formats import MOST_PX
from recon.clips.clip import Clip, checked_seconds
from recon.errors import InputError
from recon.files.regular import check_there

LOUDNESS, SILENT = "OPENCV_FFMPEG_LOGLEVEL", "-8"  # of a damaged video we say so ourselves, in one line
OPTIONS, PROTOCOLS = "OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist"
LEAST_STEP_S = 1e-6  # between frames' time stamps; without them all are 0


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
    video = _opened(path)
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


def _opened(path: Path) -> cv2.VideoCapture:
    """The video, by FFmpeg where OpenCV has it: its own reader of MJPEG writes lines to the console."""
    backend = cv2.CAP_FFMPEG if cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG) else cv2.CAP_ANY
    given = [option for option in os.environ.get(OPTIONS, "").split("|") if option]
    if not any(option.split(";")[0].strip() == PROTOCOLS for option in given):
        given.append(f"{PROTOCOLS};file")  # a file may name others, far away
    with _environment({LOUDNESS: os.environ.get(LOUDNESS, SILENT), OPTIONS: "|".join(given)}):
        return cv2.VideoCapture(str(path), backend)


@contextmanager
def _environment(wanted: dict[str, str]) -> Iterator[None]:
    """Variables of the environment, as they were afterwards."""
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
