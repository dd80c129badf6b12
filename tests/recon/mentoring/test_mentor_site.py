"""Who has no token gets nothing; what is posted is bounded and checked; a drawing belongs to the picture it was drawn on."""

import json
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

from recon import page_server
from recon.geometry import rigid
from recon.mentoring import mentor_site, posts
from recon.mentoring.drawing_log import restore
from recon.mentoring.sightings import Sighting
from tests.recon.mentoring import desk
from tests.recon.skin_projection import skin_shapes
from tests.recon.web_visitors import answer

STROKE = {"kind": "stroke", "picture": 3, "places": [[300, 250], [340, 262]]}
ANNA, BOB = (f"/{token}" for token in desk.TOKENS.values())


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@contextmanager
def open_site(folder, **others):
    site = desk.site(folder, **others)
    with page_server.listen("view", most_visitors=16).serving(site) as address:
        yield site, address


@pytest.fixture
def desk_at(tmp_path):
    """A site with picture 3, which anna has seen."""
    with open_site(tmp_path, clock=Clock()) as (site, address):
        site.offer(desk.sighting(3))
        assert answer(address, f"{ANNA}/picture.jpg")[0] == 200
        yield site, address


def post(address, what, who=ANNA, kind="application/json"):
    content = what if isinstance(what, bytes) else json.dumps(what).encode()
    return answer(address, f"{who}/draw", content, **{"Content-Type": kind})


def logged(site):
    return [json.loads(line) for line in open(site.log._file.name, encoding="utf-8")]


@pytest.mark.parametrize("path", ["/", "/picture.jpg", "/state", f"{ANNA[:-1]}/", f"{ANNA}a/state", "/x/picture.jpg", "/%C3%A9/"])
def test_nothing_without_the_token(desk_at, path):
    site, address = desk_at
    assert answer(address, path)[0] == 403
    assert "refused: expected an address with the token" in logged(site)[-1]["words"]


def test_no_post_without_the_token(desk_at):
    site, address = desk_at
    assert answer(address, "/draw", json.dumps(STROKE).encode(), **{"Content-Type": "application/json"})[0] == 403
    assert len(site.drawings) == 0


def test_tokens_are_long_and_all_unlike():
    tokens = mentor_site.new_tokens([f"m{k}" for k in range(8)])
    assert len(set(tokens.values())) == 8 and min(map(len, tokens.values())) >= 24
    assert tokens != mentor_site.new_tokens(list(tokens))


def test_the_page_needs_nothing_from_elsewhere(desk_at):
    status, page = answer(desk_at[1], f"{ANNA}/")
    assert status == 200 and b"<canvas" in page
    assert not any(word in page for word in (b"http:", b"https:", b"//cdn", b"src=", b"@import"))


def test_a_stroke_is_cast_on_the_picture_that_it_names(desk_at, tmp_path):
    """A newer picture, of the skin elsewhere, has come meanwhile; the log says where it is, and a log is enough to restore it."""
    site, address = desk_at
    site.offer(desk.sighting(4, rigid.transform(np.eye(3), [10.0, 0, 0])))
    assert answer(address, f"{ANNA}/picture.jpg")[0] == 200
    places = []
    for picture in (3, 4):
        status, content = post(address, STROKE | {"picture": picture})
        assert status == 200 and json.loads(content)["on_skin"] == 1
        places.append(list(site.drawings)[-1].curve.points)
    np.testing.assert_allclose(places[0] - places[1], np.broadcast_to([10.0, 0, 0], places[0].shape), atol=0.3)
    ray = desk.camera().rays([300.0, 250.0])
    np.testing.assert_allclose(places[0][0], ray * skin_shapes.PLANE_MM / ray[2], atol=1e-3)
    again = restore(tmp_path / "log.jsonl", tmp_path / "skin.ply")
    np.testing.assert_allclose([drawing.curve.points for drawing in again], places, atol=1e-4)


def test_drawings_are_seen_in_the_picture_unless_it_is_plain(desk_at):
    _, address = desk_at

    def shown(query=""):
        return cv2.imdecode(np.frombuffer(answer(address, f"{ANNA}/picture.jpg{query}")[1], np.uint8), cv2.IMREAD_COLOR)

    plain = shown()
    assert np.ptp(plain[256, 320].astype(int)) < 3, "grey"
    post(address, STROKE)
    thin = shown()
    assert thin[256, 320, 2] > thin[256, 320, 0] + 60 and np.ptp(thin[240, 320].astype(int)) < 20, "yellow on the line"
    assert np.abs(shown("?plain").astype(int) - plain).max() < 3


@pytest.mark.parametrize(("image", "bits"), [(np.uint8([[3, 60], [0, 12]]), 8), (np.uint16([[48, 960], [0, 192]]), 12)])
def test_a_dark_film_is_seen_as_bright_as_people_look_at_it(image, bits):
    """The rig's frames have their white at 60 of 255: ratios of brightness stay, and so does black."""
    sighting = Sighting(3, 0, np.kron(image, np.ones((32, 32), image.dtype)), None)
    shown = cv2.imdecode(np.frombuffer(mentor_site.encoded(sighting, bits, (), desk.camera()), np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_allclose(shown[16::32, 16::32], [[11, 220], [0, 44]], atol=3)


@pytest.mark.parametrize(("what", "complaint"), [
    (STROKE | {"picture": 2}, "picture: expected one of the last 600 that were sent, found 2"),
    (STROKE | {"picture": 3.5}, "picture: expected"),
    (STROKE | {"picture": "3"}, "picture: expected"),
    (STROKE | {"places": []}, "places: expected a length of at least 1"),
    (STROKE | {"places": [[300, 250]] * 2001}, "places: expected a length of at most 2000"),
    (STROKE | {"places": [[300, 250, 1]]}, "places.0: expected a length of at most 2"),
    (STROKE | {"places": [["300", 250]]}, "places.0.0: expected"),
    (STROKE | {"places": [[5, 5], [5, 6]]}, "expected the drawing on the skin, found none of it there"),
    (STROKE | {"width_mm": 50}, "width_mm: expected"),
    (STROKE | {"colour": "red"}, "colour: expected no such field"),
    ({"kind": "text", "picture": 3, "at": [300, 250], "text": "x" * 81}, "text: expected"),
    ({"kind": "text", "picture": 3, "at": [300, 250], "text": "a\nb"}, "text: expected letters in one line"),
    ({"kind": "text", "picture": 3, "at": [300, 250], "text": "  "}, "text: expected letters in one line"),
    ({"kind": "erase"}, "kind: expected one of 'stroke', 'text', 'undo', 'clear'"),
    (b'{"kind": "stroke", "picture": 3, "places": [[NaN, 250], [1, 1]]}', "places.0.0: expected a finite number"),
    (b'{"kind": "stroke", "picture": 3, "places": [[1e999, 250], [1, 1]]}', "places.0.0: expected a finite number"),
    (b'{"kind": "stroke"', "expected JSON, found damaged data"),
    (b"[" * 60_000, "expected JSON, found damaged data"),
    (b"\xff\xfe", "expected JSON, found damaged data"),
    (b"", "expected JSON, found damaged data"),
])  # fmt: skip
def test_what_cant_be_drawn_is_refused_with_its_field(desk_at, what, complaint):
    site, address = desk_at
    status, said = post(address, what)
    assert status == 400 and complaint in said.decode() and "\n" not in said.decode()
    assert len(site.drawings) == 0 and "refused" in logged(site)[-1]["words"]


def test_a_post_is_small_and_of_json_alone(desk_at):
    """A form of another page in the browser could send it as text, but not as JSON."""
    site, address = desk_at
    assert post(address, b" " * (posts.MOST_BYTES + 1))[0] == 413
    assert post(address, STROKE, kind="text/plain")[0] == 415
    assert answer(address, f"{ANNA}/erase", b"{}", **{"Content-Type": "application/json"})[0] == 404
    assert len(site.drawings) == 0


def test_a_picture_in_which_the_patient_is_lost_cant_be_drawn_on(desk_at):
    site, address = desk_at
    site.offer(desk.lost(4))
    assert answer(address, f"{ANNA}/picture.jpg")[0] == 200, "it is shown all the same"
    assert "picture: expected one in which the patient's target is found" in post(address, STROKE | {"picture": 4})[1].decode()


def test_a_picture_that_was_not_sent_cant_be_drawn_on(desk_at):
    site, address = desk_at
    site.offer(desk.sighting(4))
    assert post(address, STROKE | {"picture": 4})[0] == 400


def test_undo_takes_back_ones_own_and_clear_all(desk_at):
    site, address = desk_at
    numbers = [json.loads(post(address, STROKE, who)[1])["number"] for who in (ANNA, BOB, ANNA, BOB)]
    assert numbers == [0, 1, 2, 3]
    assert json.loads(post(address, {"kind": "undo"}, ANNA)[1]) == {"removed": [2]}
    assert json.loads(post(address, {"kind": "undo"}, ANNA)[1]) == {"removed": [0]}
    assert json.loads(post(address, {"kind": "undo"}, ANNA)[1]) == {"removed": []}
    assert [drawing.who for drawing in site.drawings] == ["bob", "bob"]
    assert json.loads(post(address, {"kind": "clear"}, ANNA)[1]) == {"removed": [1, 3]} and len(site.drawings) == 0
    assert json.loads(post(address, STROKE)[1])["number"] == 4, "no number is given twice"


def test_twenty_posts_a_second_and_no_more(desk_at):
    site, address = desk_at
    for _ in range(mentor_site.MOST_POSTS):
        assert post(address, {"kind": "undo"})[0] == 200
    assert post(address, {"kind": "undo"})[0] == 429
    assert post(address, {"kind": "undo"}, BOB)[0] == 200, "another mentor's are counted apart"
    site.clock.now += 1.01
    assert post(address, {"kind": "undo"})[0] == 200


def test_places_for_drawings_run_out(desk_at, monkeypatch):
    site, address = desk_at
    monkeypatch.setattr("recon.mentoring.drawings.MOST_DRAWINGS", 2)
    assert [post(address, STROKE)[0] for _ in range(3)] == [200, 200, 400]
    assert len(site.drawings) == 2
    monkeypatch.setattr("recon.mentoring.drawings.MOST_DRAWINGS", 500)
    monkeypatch.setattr("recon.mentoring.drawings.MOST_POINTS", 50)
    assert "m of lines in all drawings, found them used up" in post(address, STROKE)[1].decode()


def test_a_ninth_mentor_waits_for_a_place(tmp_path, monkeypatch):
    monkeypatch.setattr(desk, "TOKENS", {f"m{k}": f"{k}" * 24 for k in range(9)})
    with open_site(tmp_path, clock=Clock()) as (site, address):
        assert [answer(address, f"/{token}/state")[0] for token in desk.TOKENS.values()] == [200] * 8 + [503]
        site.clock.now += mentor_site.FORGOTTEN_S + 0.1
        assert answer(address, f"/{'8' * 24}/state")[0] == 200


def test_who_comes_and_leaves_is_said_and_what_was_drawn_stays(tmp_path):
    said = []
    with open_site(tmp_path, clock=Clock(), say=said.append) as (site, address):
        site.offer(desk.sighting(3))
        answer(address, f"{ANNA}/picture.jpg")
        post(address, STROKE)
        assert json.loads(answer(address, f"{ANNA}/state")[1])["here"] == ["anna"]
        site.clock.now += mentor_site.FORGOTTEN_S + 0.1
        site.offer(desk.sighting(4))
        assert said == ["anna is there, from 127.0.0.1", "anna has left, from 127.0.0.1; 1 drawings stay"]
        assert len(site.drawings) == 1 and logged(site)[-1]["words"] == said[-1]
        state = json.loads(answer(address, f"{BOB}/state")[1])
        assert state["drawings"][0]["who"] == "anna" and state["drawings"][0]["age_s"] >= 0


def test_refusals_fill_no_disk(desk_at, monkeypatch):
    site, address = desk_at
    monkeypatch.setattr(mentor_site, "MOST_NOTES", 3)
    for _ in range(6):
        answer(address, "/")
    words = [line["words"] for line in logged(site) if line["event"] == "noted" and "refused" in line["words"]]
    assert len(words) == 3 and words[-1].endswith("later ones aren't noted")


def test_a_full_disk_draws_nothing_and_is_said(desk_at, monkeypatch):
    site, address = desk_at

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(site.log, "_write", full)
    status, said = post(address, STROKE)
    assert status == 507 and b"No space left" in said and len(site.drawings) == 0
