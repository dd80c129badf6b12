"""Whether a display shows what a sequence asks for, on a screen without a monitor."""

import threading
import time
from pathlib import Path

import numpy as np
import pyglet
import pytest

from recon.artwork import projected_images
from recon.capture.surface_part import read_patterns
from recon.devices.displays import displays
from recon.devices.interfaces import DeviceError
from recon.devices.projector_window import ProjectorWindow
from tests.patience import PATIENCE_S
from tests.recon.devices.open_sockets import sockets
from tests.recon.devices.x_server import covered, move_windows, set_output, set_ramp, x_server
from twin.experiments.virtual_screen import screenshot

ROOT = Path(__file__).resolve().parents[3]
SEQUENCES = ["gray_opencv", "multi_frequency", "twelve_step_gray"]  # one for each size of projector


@pytest.fixture(scope="module")
def desktop():
    """A desktop of four displays, each a screen of its own: 0 of the laptop, others as projectors."""
    with x_server("640x480x24", "1280x800x24", "1024x768x24", "1920x1080x24") as display, pytest.MonkeyPatch.context() as patch:
        patch.setenv("DISPLAY", display)
        yield display


@pytest.mark.parametrize("name", SEQUENCES)
def test_patterns_arrive_pixel_by_pixel(desktop, name):
    """Six of each sequence, the first and the last among them."""
    images = projected_images.images(read_patterns(ROOT / f"conf/patterns/{name}.yaml"))
    size = images.shape[:0:-1]
    index = next(one.index for one in displays() if one.size == size)
    projector = ProjectorWindow(size, index, delay_s=0)
    try:
        for image in images[np.linspace(0, len(images) - 1, 6).astype(int)]:
            projector.show(image)
            shot = screenshot(f"{desktop}.{index}")
            assert (shot == image[..., None]).all()
    finally:
        projector.close()


@pytest.fixture
def projector(desktop):
    """The second display as a projector."""
    window = ProjectorWindow((1280, 800), 1, delay_s=0)
    yield window
    window.close()


@pytest.fixture
def noise(rng):
    """A pattern that no filter, scale or offset leaves as it is."""
    return rng.integers(0, 256, (800, 1280)).astype(np.uint8)


def test_only_the_chosen_display_is_lit(desktop, projector, noise):
    projector.show(noise)
    assert [bool(screenshot(f"{desktop}.{index}").any()) for index in range(4)] == [False, True, False, False]


def test_the_window_is_where_its_display_is_on_the_desktop(monkeypatch, rng):
    """A display beside others: nothing of the desktop around it is lit."""
    pattern = rng.integers(1, 256, (240, 320)).astype(np.uint8)
    with x_server("1280x1024x24") as desktop:
        monkeypatch.setenv("DISPLAY", desktop)
        set_output(desktop, (320, 240), (640, 480))
        window = ProjectorWindow((320, 240), 0, delay_s=0)
        window.show(pattern)
        shot = screenshot(desktop)[..., 1]
        window.close()
    assert np.array_equal(shot[480:720, 640:960], pattern)
    assert np.count_nonzero(shot) == pattern.size


def test_the_time_that_is_told_lies_behind_the_measured_delay(projector, noise):
    projector.delay_s = 0.05
    begin = time.monotonic_ns()
    lit = projector.show(noise)
    assert begin + 50_000_000 <= lit <= time.monotonic_ns()


def test_a_closed_projector_is_dark_and_refuses(desktop, noise):
    window = ProjectorWindow((1280, 800), 1, delay_s=0)
    window.show(noise)
    window.close()
    window.close()
    assert not screenshot(f"{desktop}.1").any()
    with pytest.raises(DeviceError, match="expected an open window"):
        window.show(noise)


def left_behind() -> tuple[int, int, int]:
    """Sockets, windows and threads of this process."""
    return sockets(), len(pyglet.app.windows), sum(one.name.startswith("projector") for one in threading.enumerate())


@pytest.mark.parametrize("fails", ["pyglet.image.Texture.create", "pyglet.window.Window.flip", "threading.Thread.start"])
def test_what_fails_while_it_opens_leaves_nothing_behind(desktop, monkeypatch, fails):
    """A fault of OpenGL's or of the system's, once the window is there."""
    ProjectorWindow((1280, 800), 1, delay_s=0).close()
    before, start = left_behind(), threading.Thread.start

    def fail(*given, **_):
        if fails.startswith("threading") and given[0].name != "projector messages":
            return start(given[0])
        raise RuntimeError("out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(fails, fail)
        with pytest.raises(RuntimeError, match="out of memory"):
            ProjectorWindow((1280, 800), 1, delay_s=0)
    assert left_behind() == before and not screenshot(f"{desktop}.1").any()


def test_a_window_that_cannot_be_darkened_is_closed_all_the_same(desktop, monkeypatch, noise):
    ProjectorWindow((1280, 800), 1, delay_s=0).close()
    before = left_behind()
    window = ProjectorWindow((1280, 800), 1, delay_s=0)
    window.show(noise)

    def fail(_):
        raise RuntimeError("the graphics card is gone")

    with monkeypatch.context() as patch:
        patch.setattr(type(window._canvas._window), "flip", fail)
        with pytest.raises(RuntimeError, match="graphics card"):
            window.close()
    assert left_behind() == before and not screenshot(f"{desktop}.1").any()


def test_what_was_covered_comes_back(desktop, projector, noise):
    """Another program's window over it, for a moment."""
    projector.show(noise)
    with covered(f"{desktop}.1"):
        assert not np.array_equal(screenshot(f"{desktop}.1")[..., 0], noise)
    end = time.monotonic() + PATIENCE_S
    while not np.array_equal(screenshot(f"{desktop}.1")[..., 0], noise):
        assert time.monotonic() < end, "still covered"
        time.sleep(0.05)


def test_a_desktop_that_changes_is_found(desktop, projector, noise):
    """An unplugged projector's window ends up on another display."""
    move_windows(f"{desktop}.1", 30, 20)
    with pytest.raises(DeviceError, match=r"window on display 1 \(screen.*found it at 30, 20.*unplugged"):
        projector.show(noise)


@pytest.mark.parametrize("shape", [(1024, 1280), (800, 1280, 3), (800,)])
def test_patterns_of_another_size_are_refused(projector, shape):
    with pytest.raises(DeviceError, match="expected patterns of 1280x800 px of 8 bits, found"):
        projector.show(np.zeros(shape, np.uint8))


def test_levels_that_a_display_cannot_show_are_refused(monkeypatch):
    """At 16 bits of colour a level is one of 32."""
    with x_server("320x240x16") as desktop:
        monkeypatch.setenv("DISPLAY", desktop)
        with pytest.raises(DeviceError, match="expected 24 bits of colour, found 16 on display 0"):
            ProjectorWindow((320, 240), 0, delay_s=0)


def test_a_graphics_card_without_opengl_is_refused(desktop, monkeypatch):
    def refuse(**_):
        raise pyglet.window.NoSuchConfigException("No standard config is available.")

    monkeypatch.setattr(pyglet.window, "Window", refuse)
    with pytest.raises(DeviceError, match=r"expected OpenGL 3.3 .* found No standard config is available.: install the graphics"):
        ProjectorWindow((1280, 800), 1)


def test_a_bent_ramp_is_warned_of(monkeypatch, caplog):
    with x_server("320x240x24") as desktop:
        monkeypatch.setenv("DISPLAY", desktop)
        set_ramp(desktop, np.linspace(0, 1, 256))
        ProjectorWindow((320, 240), 0, delay_s=0).close()
        assert not caplog.records
        set_ramp(desktop, np.linspace(0, 0.8, 256))
        ProjectorWindow((320, 240), 0, delay_s=0).close()
    assert "moves levels by up to 51 of 255: switch off night light" in caplog.text
