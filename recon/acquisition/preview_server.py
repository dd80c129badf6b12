"""A page on this computer that shows each device's latest image, its figures and its faults while a capture is recorded.

It is served to this computer alone unless told otherwise, takes nothing but requests for its own few addresses, and costs nothing
while no browser looks at it: images are made smaller and encoded when they are asked for.
"""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.acquisition.pictures import Over, Picture
from recon.errors import InputError
from recon.own_requests import FOREIGN, LOOPBACK, is_own

MOST_VISITORS = 8  # at once
PATIENCE_S = 5.0  # with a visitor who says nothing


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


class _Handler(BaseHTTPRequestHandler):
    """Answers `/`, `/state` and `/DEVICE.jpg`, and nothing else."""

    preview: Preview
    listens: str  # host where the server does
    timeout = PATIENCE_S

    def do_GET(self) -> None:
        """Answer a request."""
        path = self.path.partition("?")[0]
        if not is_own(self.headers.get_all("Host", []), self.headers.get_all("Origin", []), self.listens):
            self.send_error(HTTPStatus.FORBIDDEN, explain=FOREIGN)
        elif path == "/":
            self._send("text/html; charset=utf-8", files("recon.acquisition").joinpath("preview.html").read_bytes())
        elif path == "/state":
            self._send("application/json", json.dumps(self.preview.state()).encode())
        elif path.endswith(".jpg") and (image := self.preview.jpeg(path[1:-4])) is not None:
            self._send("image/jpeg", image)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: a browser asks ten times a second."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = MOST_VISITORS

    def __init__(self, address: tuple[str, int], handler: type[_Handler]) -> None:
        self._places = threading.BoundedSemaphore(MOST_VISITORS)
        super().__init__(address, handler)

    def process_request(self, request, client_address) -> None:
        """Answer in a thread, if there are not too many."""
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request, client_address) -> None:
        """Answer; a visitor who went away is no fault."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request, client_address) -> None:
        """Say nothing of a visitor who went away."""


@contextmanager
def served(preview: Preview, host: str = LOOPBACK, port: int = 0) -> Iterator[str]:
    """Serve the page; gives its address. A port of 0 takes any that is free.

    Raises
    ------
    InputError
        If the port is taken, or the host isn't this computer's.
    """
    handler = type("Handler", (_Handler,), {"preview": preview, "listens": host})
    try:
        server = _Server((host, port), handler)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"preview: expected {host}:{port} to be free, found: {reason}; give preview.port=0") from None
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://{host}:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
