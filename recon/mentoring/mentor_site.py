"""The page of mentors: camera 1's newest picture, what is drawn, and what may be posted. For each mentor an address with a token.

A picture is sent with its number, and a drawing names the number that it was drawn on: it is cast onto the skin as it stood then.
"""

import hmac
import json
import logging
import secrets
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.resources import files
from threading import Lock
from time import monotonic, time_ns

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError, short
from recon.geometry.camera import Camera
from recon.mentoring import posts, stroke_casting
from recon.mentoring.drawing_log import DrawingLog
from recon.mentoring.drawings import Drawing, Drawings
from recon.mentoring.posts import Clear, Stroke, Text, Undo
from recon.mentoring.sightings import Sighting
from recon.page_server import Answer, Refusal, Request
from recon.skin_projection.live_picture import seen_from_skin
from recon.tracking.overlays import brightened

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

MOST_CLIENTS = 8  # computers and mentors, at once
MOST_POSTS = 20  # a second of a client
FORGOTTEN_S = 5.0  # after which a client who doesn't ask has left
KEPT = 600  # pictures that may be drawn on, of those that were sent
MOST_NOTES = 1000  # of visitors who were refused, in the log of a session
PAGE = {
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
    "img-src 'self' blob: data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Referrer-Policy": "no-referrer",
}


def new_tokens(names: Sequence[str]) -> dict[str, str]:
    """A random token for each mentor, by name: who has it may look and draw."""
    return {name: secrets.token_urlsafe(18) for name in names}


@dataclass
class _Client:
    """A mentor at a computer."""

    asked: float  # monotonic s
    posted: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_POSTS))


@dataclass
class MentorSite:
    """What mentors see and do; used by many threads."""

    skin: trimesh.Trimesh  # in its own frame
    camera: Camera  # camera 1 in the world
    bits: int  # of its images
    drawings: Drawings
    log: DrawingLog
    tokens: dict[str, str]  # by the mentor's name
    status: Callable[[], str] = lambda: ""  # of the light
    say: Callable[[str], None] = lambda words: None  # of who comes and goes
    clock: Callable[[], float] = monotonic  # s
    _clients: dict[tuple[str, str], _Client] = field(default_factory=dict)
    _newest: Sighting | None = None
    _places: OrderedDict[int, Array | None] = field(default_factory=OrderedDict)  # of the skin, by pictures that were sent
    _encoded: tuple[tuple[int, int, bool], bytes] | None = None
    _notes: int = 0
    _lock: Lock = field(default_factory=Lock)  # of clients and pictures
    _drawing: Lock = field(default_factory=Lock)  # one draws at a time

    def offer(self, sighting: Sighting) -> None:
        """Take in the newest picture."""
        if sighting.image is not None:
            self._newest = sighting
        self._look_who_left()

    def answer(self, request: Request) -> Answer | None:
        """Answer a request, as a `Site`."""
        token, _, place = request.path.removeprefix("/").partition("/")
        who = self._who(token)
        client = self._client(request.peer, who)
        if request.method == "POST":
            if place != "draw":
                return None
            self._check_rate(client)
            if request.kind != "application/json":
                raise Refusal(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"expected application/json, found {short(request.kind)}")
            return self._posted(who, request.body(posts.MOST_BYTES))
        if place == "":
            page = files("recon.mentoring").joinpath("mentor.html").read_bytes()
            return Answer("text/html; charset=utf-8", page, PAGE)
        if place == "picture.jpg":
            return self._picture(plain=request.query == "plain")
        if place == "state":
            return Answer("application/json", json.dumps(self.state()).encode())
        return None

    def refused(self, peer: str, words: str) -> None:
        """Note a visitor who was sent away, some of them in a session."""
        with self._lock:
            self._notes += 1
            if self._notes > MOST_NOTES:
                return
        words = f"{peer}: refused: {words}" if self._notes < MOST_NOTES else f"{peer}: refused; later ones aren't noted"
        log.info("%s", words)
        self._write_note(words)

    def state(self) -> dict[str, object]:
        """What there is to say."""
        now, sighting = time_ns(), self._newest
        drawn = [
            {"number": each.number, "who": each.who, "text": each.words, "age_s": round((now - each.time_ns) / 1e9, 1)}
            for each in self.drawings
        ]
        with self._lock:
            here = sorted({who for _, who in self._clients})
        return {"picture": None if sighting is None else sighting.number, "light": self.status(), "drawings": drawn, "here": here}

    def _who(self, token: str) -> str:
        """The mentor of a token; each is compared, in a time that tells nothing of it."""
        found = [name for name, own in self.tokens.items() if hmac.compare_digest(own.encode(), token.encode(errors="replace"))]
        if not found:
            raise Refusal(HTTPStatus.FORBIDDEN, "expected an address with the token that was printed, found another")
        return found[0]

    def _client(self, peer: str, who: str) -> _Client:
        self._look_who_left()
        with self._lock:
            new = (peer, who) not in self._clients
            if new and len(self._clients) >= MOST_CLIENTS:
                raise Refusal(
                    HTTPStatus.SERVICE_UNAVAILABLE, f"expected at most {MOST_CLIENTS} mentors at once, found all places taken"
                )
            client = self._clients.setdefault((peer, who), _Client(self.clock()))
            client.asked = self.clock()
        if new:
            self._note(f"{who} is there, from {peer}")
        return client

    def _look_who_left(self) -> None:
        with self._lock:
            gone = [key for key, client in self._clients.items() if self.clock() - client.asked > FORGOTTEN_S]
            for key in gone:
                del self._clients[key]
        for peer, who in gone:
            stays = f"; {len(self.drawings)} drawings stay" if len(self.drawings) else ""
            self._note(f"{who} has left, from {peer}{stays}")

    def _note(self, words: str) -> None:
        self.say(words)
        self._write_note(words)

    def _write_note(self, words: str) -> None:
        try:
            self.log.noted(words)
        except OSError as error:  # a full disk must not end the light
            log.error("log: %s", error.strerror)

    def _check_rate(self, client: _Client) -> None:
        with self._lock:
            now = self.clock()
            if len(client.posted) == MOST_POSTS and now - client.posted[0] < 1:
                raise Refusal(HTTPStatus.TOO_MANY_REQUESTS, f"expected at most {MOST_POSTS} posts a second, found more")
            client.posted.append(now)

    def _picture(self, plain: bool) -> Answer:
        sighting, changes = self._newest, self.drawings.changes
        if sighting is None or sighting.image is None:
            raise Refusal(HTTPStatus.CONFLICT, "expected a picture of camera 1, found none yet")
        key = sighting.number, changes, plain
        with self._lock:
            if sighting.number not in self._places:
                self._places[sighting.number] = sighting.world_from_skin
                while len(self._places) > KEPT:
                    self._places.popitem(last=False)
            if self._encoded is None or self._encoded[0] != key:
                self._encoded = key, encoded(sighting, self.bits, () if plain else tuple(self.drawings), self.camera)
            return Answer("image/jpeg", self._encoded[1], {"X-Picture": str(sighting.number)})

    def _posted(self, who: str, content: bytes) -> Answer:
        try:
            post = posts.read(content)
            with self._drawing:
                done = self._do(who, post)
        except InputError as error:
            raise Refusal(HTTPStatus.BAD_REQUEST, str(error)) from None
        except OSError as error:
            raise Refusal(HTTPStatus.INSUFFICIENT_STORAGE, f"the log can't be written: {error.strerror}") from None
        return Answer("application/json", json.dumps(done).encode())

    def _do(self, who: str, post: posts.Post) -> dict[str, object]:
        """Do what was posted; it is written before it is lit."""
        if isinstance(post, Undo):
            last = self.drawings.last_of(who)
            numbers = [] if last is None else [last.number]
            self.log.removed("undone", who, numbers)
            self.drawings.remove(numbers)
            return {"removed": numbers}
        if isinstance(post, Clear):
            numbers = [drawing.number for drawing in self.drawings]
            self.log.removed("cleared", who, numbers)
            self.drawings.remove(numbers)
            return {"removed": numbers}
        number = self.drawings.next_number
        camera = seen_from_skin(self.camera, self._place(post.picture))
        curve = stroke_casting.cast(f"drawing{number}", post, camera, self.skin)
        self.drawings.check_room(curve)
        words = post.text if isinstance(post, Text) else ""
        drawing = Drawing(number, who, time_ns(), words, stroke_casting.look(post), curve)
        self.log.drawn(drawing, post.picture, post.places if isinstance(post, Stroke) else [post.at])
        self.drawings.add(drawing)
        return {"number": number, "length_mm": round(curve.length_mm, 2), "on_skin": round(curve.on_skin, 4)}

    def _place(self, picture: int) -> Array:
        """Where the skin was in a picture that was sent."""
        with self._lock:
            if picture not in self._places:
                raise InputError(f"picture: expected one of the last {KEPT} that were sent, found {picture}")
            place = self._places[picture]
        if place is None:
            raise InputError(f"picture: expected one in which the patient's target is found, found {picture}: draw on another")
        return place


def encoded(sighting: Sighting, bits: int, drawings: Sequence[Drawing], camera: Camera) -> bytes:
    """A picture of camera 1 as JPEG, brightened, with thin lines where drawings are on the skin, in it."""
    image = sighting.image
    assert image is not None
    shown = brightened(image, bits)
    if sighting.world_from_skin is not None:
        device = seen_from_skin(camera, sighting.world_from_skin)
        for drawing in drawings:
            pieces = [np.rint(piece * 16).astype(np.int32) for piece in stroke_casting.seen(drawing.curve, device)]
            cv2.polylines(shown, pieces, False, (60, 200, 255), 1, cv2.LINE_AA, shift=4)
    quality = 80  # of JPEG: some 150 kB of a picture of the rig
    return cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
