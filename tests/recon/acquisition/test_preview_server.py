"""The page shows what is recorded, to this computer alone, and answers nobody else."""

import json
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from recon.acquisition.pictures import Over, Picture
from recon.acquisition.preview_server import Preview, served
from recon.errors import InputError
from tests.recon.navigation import headless_browser
from tests.recon.web_visitors import answer


def test_the_page_shows_images_figures_and_faults():
    preview = Preview()
    image = np.full((1024, 1280), 400, np.uint16)
    image[:, 640:] = 1023
    preview.show(Picture("cam1", image, 10, "brightest 100 %", ("saturated: 50 %; halve the exposure",)))
    preview.say("exposure cam1 10 ms")
    with served(preview) as address:
        assert b"/state" in answer(address, "/")[1]
        state = json.loads(answer(address, "/state")[1])
        shown = cv2.imdecode(np.frombuffer(answer(address, "/cam1.jpg?7")[1], np.uint8), cv2.IMREAD_COLOR)
        assert answer(address, "/state", b"{}")[0] == 405
        assert answer(address, "/cam2.jpg")[0] == answer(address, "/../conf/record.yaml")[0] == 404
    assert state["devices"] == [
        {"name": "cam1", "number": 1, "text": "brightest 100 %", "faults": ["saturated: 50 %; halve the exposure"], "way": ""}
    ]
    assert state["said"] == ["exposure cam1 10 ms"] and max(shown.shape) == 640
    assert np.abs(shown[100, 100].astype(float) - 400 / 1023 * 255).max() < 4 and shown[100, 600, 2] > 200 > shown[100, 600, 0]


@pytest.mark.parametrize("there", [False, True])
def test_a_place_is_drawn_where_it_is_asked_for(there):
    """In yellow, in green when it is reached, on the smaller image; its mark is filled, and the way is said."""
    preview, corners = Preview(), np.array([[200.0, 200.0], [1000.0, 200.0], [1000.0, 800.0], [200.0, 800.0]])
    over = Over("60 mm nearer", corners, np.array([300.0, 300.0]), there)
    preview.show(Picture("cam1", np.full((1024, 1280), 100, np.uint8), 8, "", (), over))
    shown = cv2.imdecode(np.frombuffer(preview.jpeg("cam1"), np.uint8), cv2.IMREAD_COLOR).astype(int)
    for u, v in ((300, 100), (500, 250), (150, 150)):
        blue, green, red = shown[v, u]
        assert green > 170 and (red < 130 if there else red > 220), (u, v, blue, green, red)
    assert np.abs(shown[250, 300] - 100).max() < 8
    assert preview.state()["devices"][0]["way"] == "60 mm nearer"


PLACES = "JSON.stringify([...document.images].map(image => [image.alt, image.x, image.y]))"


def test_cameras_stand_side_by_side(tmp_path):
    """Camera 1, then 2, on a page of 1000 px, whichever frame came first; the B-scan below them."""
    preview = Preview()
    for device in ("us", "cam2", "cam1"):
        preview.show(Picture(device, np.full((1024, 1280), 90, np.uint8), 8, "frame 12, no target"))
    with served(preview) as address, headless_browser.opened(address, tmp_path / "profile") as page:
        placed = page.until(lambda page: len(found := json.loads(page.run(PLACES))) == 3 and found)
        assert page.complaints == []
    (first, *left), (second, *right), (third, *below) = placed
    assert (first, second, third) == ("cam1", "cam2", "us")
    assert left[1] == right[1] < below[1] and left[0] == below[0] < right[0]


def test_pages_of_others_see_nothing():
    """A page in the same browser that calls this one by a name of its own, or by this one's name from elsewhere."""
    with served(Preview()) as address:
        assert answer(address, "/state", Host="evil.example:80")[0] == 403
        assert answer(address, "/state", Origin="https://evil.example")[0] == 403
        assert answer(address, "/state", Host="localhost:80")[0] == 200


def test_a_taken_port_is_named():
    with served(Preview()) as address:
        port = urlsplit(address).port
        with pytest.raises(InputError, match=f"expected 127.0.0.1:{port} to be free"), served(Preview(), port=port):
            pass
