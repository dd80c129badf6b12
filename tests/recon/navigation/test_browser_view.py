"""The view: what it says of a moment, and a page that opens and shows the B-scan where it is."""

import socket
from time import sleep

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.tip import Tip
from recon.navigation import browser_view
from recon.navigation.browser_view import LOOPBACK, BrowserView
from recon.navigation.mass_distances import MassDistance, bodies_of, distances
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import BodyAt, Latency, Moment, StillScene
from recon.navigation.seen_so_far import SeenSoFar
from recon.navigation.tool_distances import AtPlane, Crossing, TipFigures
from tests.recon.navigation import headless_browser

pytest.importorskip("viser")

BALL = trimesh.creation.icosphere(3, 60.0).apply_translation([0, 0, 700])
POSE = rigid.transform(np.eye(3), [0, 0, 640])
SHAPE, MM_PER_PX = (120, 80), 0.5
CANVAS = "[...document.querySelectorAll('canvas')].map(each => each.getBoundingClientRect()).sort((a, b) => b.width - a.width)[0]"


TIP = Tip(np.array([0.0, 0, -150]), np.eye(6), np.array([0.0, 0, -1]))


def needle_at(plane, pose=POSE):
    """A needle whose shaft lies beside a B-scan as given."""
    return BodyAt("needle", "predicted", pose, pose, TipFigures(np.zeros(3), np.eye(3), TIP.axis, {}, None, plane))


def free_port():
    with socket.socket() as any_port:
        any_port.bind((LOOPBACK, 0))
        return any_port.getsockname()[1]


def scan_of(image, world_from_pixel=None):
    placed = np.diag([MM_PER_PX, MM_PER_PX, MM_PER_PX, 1]) if world_from_pixel is None else world_from_pixel
    return PlacedScan(image, 1, 10**9, placed)


def test_directions_become_a_quaternion(rng):
    turn = Rotation.random(random_state=rng)
    matrix = rigid.transform(turn.as_matrix(), [1, 2, 3]) @ np.diag([0.12, 0.15, 0.13, 1])
    x, y, z, w = turn.as_quat()
    found = browser_view.turn_of(matrix)
    np.testing.assert_allclose(found * np.sign(found[0]), np.array([w, x, y, z]) * np.sign(w), atol=1e-12)


def test_a_mass_is_outlined_where_the_plane_cuts_it():
    """A ball about the image's pixel (30, 70), of 20 px."""
    ball = trimesh.creation.icosphere(4, 20 * MM_PER_PX).apply_translation([30 * MM_PER_PX, 70 * MM_PER_PX, 0.1])
    scan = scan_of(np.full(SHAPE, 90, np.uint8))
    picture = browser_view.outlined(scan, distances(bodies_of({"": ball}), scan))  # no name, as that is drawn, too
    v, u = np.nonzero((picture != 90).any(axis=-1))
    away = np.hypot(u - 30, v - 70)
    assert len(u) > 100 and (np.abs(away - 20) < 2.5).all()
    assert (scan.image == 90).all(), "drawn into a copy"


@pytest.mark.parametrize("ahead", [12.0, -12.0])
def test_a_tool_is_drawn_where_its_shaft_meets_the_image(ahead):
    """The part in the slice as a line, the crossing as a cross ahead of the tip, as a ring behind; into a copy."""
    picture = np.full((*SHAPE, 3), 90, np.uint8)
    seen = np.array([[10.0, 100], [10, 20]])
    drawn = browser_view.with_tools(picture, (needle_at(AtPlane(1.0, 0.1, Crossing(np.array([40.0, 60]), ahead, True), seen)),))
    changed = (drawn != picture).any(axis=-1)
    assert changed[25:95, 10].all() and not changed[:15].any() and not changed[:, :7].any()
    assert changed[60, 40] == (ahead > 0) and changed[60, 40 + browser_view.MARK_PX] == (ahead < 0)
    assert (picture == 90).all()


def test_a_crossing_beside_the_image_is_not_drawn():
    picture = np.full((*SHAPE, 3), 90, np.uint8)
    beside = needle_at(AtPlane(1.0, 0.1, Crossing(np.array([4e9, -60]), 12.0, False), None))
    lost = BodyAt("needle", "not found: no reason")
    assert (browser_view.with_tools(picture, (beside, lost)) == picture).all()


def test_a_tool_is_shown_in_space_as_long_as_it_is_seen():
    plan = np.array([[0.0, 0, 600], [10, 0, 650]])
    view = BrowserView(StillScene(np.eye(4), tools={"needle": TIP}, shapes={"needle": BALL}, plan=plan), 0)
    try:
        turned = rigid.from_rotation_vector([0, 0, 1], [10, 20, 640])
        handle = view._tools["needle"]
        assert not handle.visible
        view.publish(Moment(1, 0, None, "target not found", bodies=(BodyAt("needle", "predicted", turned),)))
        assert handle.visible
        np.testing.assert_allclose(handle.position, np.array([10, 20, 640]) * browser_view.M)
        np.testing.assert_allclose(handle.wxyz, browser_view.turn_of(turned))
        view.publish(Moment(2, 0, None, "no frames of both cameras"))
        assert not handle.visible
    finally:
        view.close()


@pytest.mark.parametrize("middle", [(40, 60), (2, 60), (40, 8), (40, 112), (78, 118)])
@pytest.mark.parametrize("half", [6, 12])
def test_a_masss_name_stands_beside_its_outline(middle, half):
    """Whole within the picture, and not over the outline, wherever that is."""
    outline = np.array(middle) + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    left, row = browser_view.name_place("mass0", outline.astype(np.int32), SHAPE)
    (width, height), below = cv2.getTextSize("mass0", *browser_view.FONT, 1)
    assert 0 <= left <= SHAPE[1] - width and height <= row <= SHAPE[0] - below
    assert row + below < outline[:, 1].min() or row - height > outline[:, 1].max()


def test_of_a_mass_as_tall_as_the_picture_the_name_stands_within():
    outline = np.array([[5, 1], [75, 1], [75, 118], [5, 118]], np.int32)
    assert browser_view.name_place("m", outline, SHAPE)[1] == pytest.approx(SHAPE[0] / 2, abs=8)


def test_a_taken_port_is_refused_in_one_line():
    with socket.socket() as other:
        other.bind((LOOPBACK, 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"view: expected to listen on 127.0.0.1:{port}, found it refused"):
            BrowserView(StillScene(np.eye(4)), port)


def test_of_port_0_it_takes_a_free_one():
    """Two of them don't meet, and each gives the address at which it is reached."""
    views = [BrowserView(StillScene(np.eye(4)), 0) for _ in range(2)]
    try:
        addresses = [view.address.removeprefix("http://").split(":") for view in views]
        assert all(reached(host, int(port)) for host, port in addresses) and addresses[0] != addresses[1]
    finally:
        for view in views:
            view.close()


def test_what_is_still_to_be_scanned_is_points_that_vanish():
    """In metres, two colours; the next map takes their place, and no new map leaves them."""
    some = SeenSoFar(0.5, 1000.0, np.array([[10, 20, 700], [13, 20, 700]], np.float32), np.array([0.1, 0.4], np.float32))
    all_seen = SeenSoFar(1.0, 1000.0, np.empty((0, 3), np.float32), np.empty(0, np.float32))
    view = BrowserView(StillScene(np.eye(4)), 0)
    try:
        for number in (1, 2):
            view.publish(Moment(number, 0, None, "target not found", seen=some))
            points = view._unseen
            np.testing.assert_allclose(points.points.astype(float), some.points * 0.001, rtol=1e-3)
            assert np.array_equal(points.colors, [browser_view.UNSEEN, browser_view.HALF_SEEN])
        view.publish(Moment(3, 0, None, "target not found", seen=all_seen))
        assert len(view._unseen.points) == 0
    finally:
        view.close()


def test_it_listens_on_this_computer_alone():
    view = BrowserView(StillScene(np.eye(4)), free_port())
    try:
        listening = {address for address in ("127.0.0.1", "127.0.0.2") if reached(address, view._server.get_port())}
    finally:
        view.close()
    assert listening == {"127.0.0.1"}


def reached(address, port):
    with socket.socket() as client:
        return client.connect_ex((address, port)) == 0


SHOWN = """(async () => {
  const image = document.querySelector('.figures img'), figure = document.querySelector('.figures .cut .number');
  if (!image || !figure) return null;
  const canvas = Object.assign(document.createElement('canvas'), {width: 1, height: 1});
  const drawn = canvas.getContext('2d');
  if (image.complete) drawn.drawImage(image, 0, 0, 1, 1);
  const [grey, , , alpha] = drawn.getImageData(0, 0, 1, 1).data;
  return figure.innerText + ' ' + grey + ' ' + alpha;
})()"""


@pytest.mark.slow
def test_figures_and_picture_are_of_one_moment(tmp_path):
    """Whenever one looks: each moment has its own grey, and the same distance; and there is always a picture."""
    view, seen = BrowserView(StillScene(np.eye(4), masses={"ball": BALL}), 0), []

    def publish(k):
        near = MassDistance("ball", -float(1 + k % 20), 0.0, np.empty((0, 2, 3)), False)
        view.publish(Moment(k, 0, POSE, "target predicted", scan_of(np.full(SHAPE, 10 * (1 + k % 20), np.uint8)), (near,)))

    try:
        with headless_browser.opened(view.address, tmp_path / "profile") as page:
            for k in range(40):
                publish(k)
                sleep(0.05)
                if (shown := page.run(SHOWN)) is not None:
                    seen.append(shown.replace("\u2212", "").split())
    finally:
        view.close()
    assert len({figure for figure, _, _ in seen}) > 5, "it goes on"
    assert all(alpha == "255" and abs(float(figure) - int(grey) / 10) < 0.4 for figure, grey, alpha in seen)


@pytest.mark.slow
def test_the_page_shows_the_b_scan_in_place(tmp_path):
    """One corner of the image is white: on the page it is where a camera of the view's own place and field sees that corner."""
    image = np.full(SHAPE, 40, np.uint8)
    image[:24, :24] = 255
    turn = upright() @ Rotation.from_euler("z", 30, degrees=True).as_matrix()
    middle = np.array([0.0, 0.0, 700.0])
    half = MM_PER_PX * (np.array(SHAPE[::-1]) - 1) / 2
    placed = rigid.transform(turn, middle - turn[:, :2] @ half) @ np.diag([MM_PER_PX, MM_PER_PX, MM_PER_PX, 1])
    view = BrowserView(StillScene(np.eye(4), masses={"mass0": BALL}), free_port())
    for name in ("/masses/mass0", "/names/mass0"):  # it only sets where one looks from
        view._server.scene.remove_by_name(name)
    try:
        with headless_browser.opened(view.address, tmp_path / "profile") as page:
            page.until(lambda page: "waiting for the first frames" in (page.run("document.body.innerText") or ""))
            view.publish(Moment(1, 0, None, "target not found", scan_of(image, placed), (), (), Latency(30, 50, 25)))
            page.until(lambda page: "99 % below 50 ms" in page.run("document.body.innerText"))
            shot = page.until(seen)
            cv2.imwrite(str(tmp_path / "page.png"), shot)
            height, width = shot.shape[:2]
            free = page.run(f"{CANVAS}.width + ' ' + {CANVAS}.height")
            assert page.complaints == []
            assert all(address.startswith(view.address) for address in page.fetched), "a hospital's PC may have no network"
    finally:
        view.close()
    free_width, free_height = (float(number) for number in free.split())
    assert free_height == height and width / 2 < free_width < width - browser_view.PANEL_PX / 2, "it ends at the figures"
    corner = placed[:3, :3] @ [12, 12, 0] + placed[:3, 3]
    expected = on_screen(corner, middle, np.linalg.norm(np.ptp(BALL.bounds, axis=0)) / 2, (free_width, height))
    v, u = np.nonzero(white_of_scene(shot))
    assert np.hypot(u.mean() - expected[0], v.mean() - expected[1]) < 6


def upright():
    """Directions of a camera at the view's place : columns across, down and ahead; y of the world is down."""
    ahead = -browser_view.ASIDE
    across = np.cross([0, 1, 0], ahead)
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(ahead, across), ahead])


def on_screen(point, middle, radius, size):
    """Pixel of a point, seen from the view's place."""
    x, y, z = upright().T @ (point - (middle + browser_view.DISTANCE * radius * browser_view.ASIDE))
    scale = size[1] / 2 / np.tan(browser_view.FIELD_RAD / 2)
    return np.array(size) / 2 + scale * np.array([x, y]) / z


def white_of_scene(shot):
    """White pixels left of the panel, below the browser's own note on its graphics."""
    white = (shot > 200).all(axis=-1)
    white[:200, :330] = False
    white[:, 660:] = False
    return white


def seen(page):
    """A picture with the white corner in it, or None."""
    shot = page.picture()
    return shot if white_of_scene(shot).sum() > 200 else None
