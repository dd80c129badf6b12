"""A page on this computer that shows each device's latest image, its figures and its faults while a capture is recorded.

It is served to this computer alone unless told otherwise, takes nothing but requests for its own few addresses, and costs nothing
while no browser looks at it: images are made smaller and encoded when they are asked for.
"""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray

from recon import page_server
from recon.acquisition.pictures import Over, Picture
from recon.own_requests import LOOPBACK
from recon.page_server import Answer, Refusal, Request


class Preview:
    """What the page shows. Written by the recording's threads, read by those of the server."""

    def __init__(self) -> None:
        self._pictures: dict[str, tuple[int, Picture]] = {}  # by device: number of the picture, and it
        self._said: list[str] = []
        self._lock = threading.Lock()

    def show(self, picture: Picture) -> None:
        """Show a device's latest image."""
        with self._lock:
            number = self._pictures.get(picture.device, (0, picture))[0]
            self._pictures[picture.device] = number + 1, picture

    def say(self, text: str) -> None:
        """Show a line."""
        said = 20  # last lines that are shown
        with self._lock:
            self._said = [*self._said, text][-said:]

    def state(self) -> dict[str, object]:
        """What there is to show, without images."""
        with self._lock:
            pictures, said = list(self._pictures.values()), list(self._said)
        devices = [
            {"name": one.device, "number": number, "text": one.text, "faults": list(one.faults), "way": _way(one)}
            for number, one in pictures
        ]
        return {"devices": devices, "said": said}

    def jpeg(self, device: str) -> bytes | None:
        """A device's latest image, smaller; pixels at full scale are red, and the outline is drawn. None without one."""
        with self._lock:
            _, picture = self._pictures.get(device, (0, None))
        if picture is None:
            return None
        full = 2**picture.bits - 1
        most_side_px = 640  # of an image on the page
        step = -(-max(picture.image.shape) // most_side_px)
        grey = picture.image[::step, ::step]
        shown = cv2.cvtColor(np.uint8(grey.astype(np.float32) * (255 / full)), cv2.COLOR_GRAY2BGR)
        shown[grey >= full] = (0, 0, 255)
        if picture.over is not None:
            _draw(shown, picture.over, step)
        return cv2.imencode(".jpg", shown)[1].tobytes()


def _way(picture: Picture) -> str:
    return "" if picture.over is None else picture.over.words


def _draw(shown: NDArray[np.uint8], over: Over, step: int) -> None:
    """Draw what lies over an image : (h, w, 3), of which each `step`th pixel is shown."""
    line, first = (np.rint(at / step).astype(np.int32) for at in (over.outline, over.first))
    asked, there = (0, 220, 255), (110, 220, 90)  # BGR, of the outline of a place, and of one that is reached
    colour = there if over.there else asked
    cv2.polylines(shown, [line], isClosed=True, color=colour, thickness=2, lineType=cv2.LINE_AA)
    cv2.circle(shown, (int(first[0]), int(first[1])), 5, colour, -1, cv2.LINE_AA)


class _Site:
    """Answers `/`, `/state` and `/DEVICE.jpg`, and nothing else."""

    def __init__(self, preview: Preview) -> None:
        self._preview = preview

    def answer(self, request: Request) -> Answer | None:
        """Answer a request."""
        if request.method != "GET":
            raise Refusal(HTTPStatus.METHOD_NOT_ALLOWED, "expected GET, as there is nothing to post to")
        if request.path == "/":
            return Answer("text/html; charset=utf-8", files("recon.acquisition").joinpath("preview.html").read_bytes())
        if request.path == "/state":
            return Answer("application/json", json.dumps(self._preview.state()).encode())
        image = self._preview.jpeg(request.path[1:-4]) if request.path.endswith(".jpg") else None
        return None if image is None else Answer("image/jpeg", image)

    def refused(self, peer: str, words: str) -> None:
        """Say nothing of it: nothing is lost by a visitor who was sent away."""


@contextmanager
def served(preview: Preview, host: str = LOOPBACK, port: int = 0) -> Iterator[str]:
    """Serve the page; gives its address. A port of 0 takes any that is free.

    Raises
    ------
    InputError
        If the port is taken, or the host isn't this computer's.
    """
    with page_server.listen("preview", host, port).serving(_Site(preview)) as address:
        yield address
