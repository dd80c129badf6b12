"""Videos opened by OpenCV, quietly, and without leave to read others that they name."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

OPTIONS, PROTOCOLS = "OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist"


def opened(path: Path) -> cv2.VideoCapture:
    """The video, by FFmpeg where OpenCV has it: its own reader of MJPEG writes lines to the console."""
    backend = cv2.CAP_FFMPEG if cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG) else cv2.CAP_ANY
    given = [option for option in os.environ.get(OPTIONS, "").split("|") if option]
    if not any(option.split(";")[0].strip() == PROTOCOLS for option in given):
        given.append(f"{PROTOCOLS};file")  # a file may name others, far away
    loudness, silent = "OPENCV_FFMPEG_LOGLEVEL", "-8"  # of a damaged video we say so ourselves, in one line
    with _environment({loudness: os.environ.get(loudness, silent), OPTIONS: "|".join(given)}):
        return cv2.VideoCapture(str(path), backend)


@contextmanager
def _environment(wanted: dict[str, str]) -> Iterator[None]:
    """Set environment variables, and restore them at the end."""
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
