"""The page in a browser: it shows the picture, and a stroke drawn by the pointer is posted where the pointer was."""

import json
from contextlib import contextmanager

import numpy as np
import pytest

from recon import page_server
from tests.recon.mentoring import desk
from tests.recon.navigation import headless_browser

CANVAS = "JSON.stringify((({left, top, width, height}) => [left, top, width, height])(canvas.getBoundingClientRect()))"


@contextmanager
def opened_page(site, folder):
    """The page of anna, as soon as it shows picture 7."""
    with (
        page_server.listen("view", most_visitors=32).serving(site) as address,
        headless_browser.opened(f"{address}{desk.TOKENS['anna']}/", folder / "profile") as page,
    ):
        page.until(lambda page: page.run("picture") == 7)
        yield page


@pytest.fixture
def opened(tmp_path):
    site = desk.site(tmp_path, status=lambda: "lit where the skin was measured")
    site.offer(desk.sighting(7))
    with opened_page(site, tmp_path) as page:
        yield site, page


def point(page, kind, place):
    page.call("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], button="left", buttons=1, clickCount=1)


def on_screen(page, places):
    """Where pixels of the picture are on the screen."""
    left, top, width, height = json.loads(page.run(CANVAS))
    assert width / height == pytest.approx(640 / 512, rel=0.01), "not stretched"
    return np.array([left, top]) + (np.array(places) + 0.5) * [width / 640, height / 512]


def draw(page, places):
    screen = on_screen(page, places).tolist()
    point(page, "mousePressed", screen[0])
    for place in screen[1:]:
        point(page, "mouseMoved", place)
    point(page, "mouseReleased", screen[-1])


def test_a_stroke_lands_where_the_pointer_was(opened):
    """To half a pixel of the screen; all is the server's own, and the browser complains of nothing."""
    site, page = opened
    places = [[290.0, 240.0], [320.0, 262.0], [352.0, 245.0]]
    draw(page, places)
    page.until(lambda page: len(site.drawings) == 1)
    (drawing,) = site.drawings
    pixels = desk.camera().project(drawing.curve.points)
    for place in places:
        assert np.linalg.norm(pixels - place, axis=1).min() < 1.5
    assert drawing.who == "anna" and drawing.line.width_mm == 1
    page.run('document.getElementById("undo").click()')
    page.until(lambda page: len(site.drawings) == 0)
    page.until(lambda page: "0 drawings" in page.run("document.body.innerText"))
    assert "lit where the skin was measured" in page.run("document.body.innerText")
    assert page.complaints == []
    assert all(address.startswith("http://127.0.0.1:") for address in page.fetched)


def test_a_text_is_put_where_it_is_clicked_and_what_is_refused_is_shown(opened):
    site, page = opened
    page.run('document.getElementById("letters").click(); document.getElementById("text").value = "here"')
    draw(page, [[300.0, 250.0]])
    page.until(lambda page: len(site.drawings) == 1)
    assert next(iter(site.drawings)).words == "here"
    draw(page, [[5.0, 5.0]])
    page.until(lambda page: "found none of it there" in page.run("document.body.innerText"))


def test_a_server_that_is_gone_is_said(tmp_path):
    site = desk.site(tmp_path)
    site.offer(desk.sighting(7))

    def hang_up(_):
        raise ConnectionError

    with opened_page(site, tmp_path) as page:
        site.answer = hang_up
        page.until(lambda page: "what was drawn stays lit" in page.run("document.body.innerText"))
