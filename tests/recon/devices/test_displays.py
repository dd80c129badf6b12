"""Whether the right display is found, and whatever would bend its patterns."""

import numpy as np
import pytest

from recon.devices import displays
from recon.devices.displays import Display
from recon.devices.interfaces import DeviceError
from tests.recon.devices.open_sockets import sockets
from tests.recon.devices.x_server import set_output, set_ramp, x_server

LAPTOP = Display(0, "eDP-1", (1920, 1080), (1920, 1080), (0, 0), 60.0)
PROJECTOR = Display(1, "HDMI-1", (1280, 800), (1280, 800), (1920, 0), 60.0)


def test_displays_are_listed_with_size_place_and_rate(monkeypatch):
    """An output that shows a part of the desktop stands for one of two displays side by side."""
    with x_server("1280x1024x24", "640x480x24") as desktop:
        monkeypatch.setenv("DISPLAY", desktop)
        set_output(desktop, (320, 240), (640, 480))
        projector, other = displays.displays()
    assert (projector.index, projector.size, projector.position) == (0, (320, 240), (640, 480))
    assert projector.rate_hz == pytest.approx(60, abs=0.1)
    assert (other.index, other.size, other.position) == (1, (640, 480), (0, 0))


def test_a_list_of_displays_leaves_no_connection_open(monkeypatch):
    """A server has room for 256 clients: whoever asks for the displays again and again would fill it."""
    with x_server("320x240x24", "320x240x24") as desktop:
        monkeypatch.setenv("DISPLAY", desktop)
        displays.displays()  # what is loaded once
        before = sockets()
        for _ in range(5):
            assert len(displays.displays()) == 2
        assert sockets() == before


@pytest.mark.parametrize("named", ["", ":12345"])
def test_without_a_desktop_the_way_on_is_named(monkeypatch, named):
    monkeypatch.setenv("DISPLAY", named)
    with pytest.raises(DeviceError, match=r"expected a desktop with displays, found (no DISPLAY|none at DISPLAY=:12345): log in"):
        displays.displays()


@pytest.mark.parametrize(
    ("found", "index", "message"),
    [
        ([LAPTOP], 1, r"expected display 1, found 0 \(eDP-1, 1920x1080 px at 0, 0, 60 Hz\): is the projector on"),
        ([LAPTOP, PROJECTOR], -1, "expected display -1"),
        ([LAPTOP, PROJECTOR], 0, r"expected a display of 1280x800 px.*found display 0.*choose another display"),
        ([Display(0, "HDMI-1", (1280, 800), (1920, 1200), (0, 0), 60.0)], 0, "signal of 1280x800 px, found one of 1920x1200 px"),
    ],
)
def test_what_would_bend_patterns_is_refused(found, index, message):
    with pytest.raises(DeviceError, match=message) as caught:
        displays.chosen(found, index, (1280, 800))
    assert "\n" not in str(caught.value)


def test_the_projector_is_chosen_by_its_index():
    assert displays.chosen([LAPTOP, PROJECTOR], 1, (1280, 800)) is PROJECTOR


def test_a_ramp_is_read_as_it_was_set(monkeypatch):
    """Night light: full scale is lowered, and a colour profile bends the middle."""
    levels = 0.9 * np.linspace(0, 1, 256) ** 1.1
    with x_server("640x480x24") as desktop:
        monkeypatch.setenv("DISPLAY", desktop)
        set_ramp(desktop, levels)
        with displays.screens() as screens:
            ramp = displays.gamma_ramp(screens[0])
    assert ramp == pytest.approx(np.tile(levels, (3, 1)), abs=1 / 65535)


def test_an_even_ramp_bends_nothing_and_a_power_does():
    even = np.tile(np.linspace(0, 1, 1024), (3, 1))
    assert displays.bent_by(even) < 1e-9
    power = even.copy()
    power[2] **= 2
    assert displays.bent_by(power) == pytest.approx(0.25, abs=1e-3)  # of x - x^2, at one half
