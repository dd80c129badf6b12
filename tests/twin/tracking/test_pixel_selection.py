"""What is made of rendered pixels is what a camera's image would give."""

import cv2
import numpy as np
import pytest

from twin.tracking.pixel_selection import VIEW, Sketch, View, Window, full_frame


def picked(image: np.ndarray, picture) -> np.ndarray:
    """Numbers of an image at a picture's pixels."""
    lanes = picture.lanes(0, 0)
    return image[lanes.v.astype(int), lanes.u.astype(int)]


@pytest.fixture
def image(rng):
    return cv2.GaussianBlur(rng.integers(0, 256, (1024, 1280), dtype=np.uint8), (0, 0), 1.5)


@pytest.mark.parametrize("size", [(1280, 1024), (1920, 1200), (640, 512)])
def test_a_view_is_opencvs_shrunk_image(rng, size):
    image = cv2.GaussianBlur(rng.integers(0, 256, size[::-1], dtype=np.uint8), (0, 0), 1.5)
    view = View(size, 1)
    assert (view.image(picked(image, view)) == cv2.resize(image, VIEW)).all()


def test_the_four_pixels_of_a_view_share_a_set_of_points():
    lanes = View((1280, 1024), 2).lanes(0, 0)
    order = np.lexsort([lanes.first, lanes.set])
    assert (lanes.set[order].reshape(-1, 4) == np.arange(VIEW[0] * VIEW[1])[:, None]).all()
    assert (lanes.first[order].reshape(-1, 4) == [0, 2, 4, 6]).all()


def test_a_window_repeats_the_border(image):
    window = Window((1280, 1024), (-10, 1000), (40, 50), 4)
    piece = window.image(picked(image, window))
    assert (piece[:, :10] == piece[:, 10:11]).all()
    assert (piece[24:] == piece[23]).all()
    assert (piece[:24, 10:] == image[1000:, :30]).all()


def test_a_full_frame_is_the_image(image):
    frame = full_frame((1280, 1024), 4)
    assert (frame.image(picked(image, frame)) == image).all()


@pytest.mark.parametrize("first", [(300, 200), (-30, -20), (1200, 950)])
def test_a_sketch_shrinks_to_the_same_view_and_holds_its_window(image, first):
    view, window = View((1280, 1024), 1), Window((1280, 1024), first, (150, 120), 4)
    sketch = Sketch(view, window)
    drawn = sketch.image(picked(image, sketch))
    assert (cv2.resize(drawn, VIEW) == cv2.resize(image, VIEW)).all()
    v, u = np.mgrid[first[1] : first[1] + 120, first[0] : first[0] + 150]
    held = (v >= 0) & (v < 1024) & (u >= 0) & (u < 1280)
    assert (drawn[v[held], u[held]] == image[v[held], u[held]]).all()
