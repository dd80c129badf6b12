"""The displays of this computer, and what could bend a pattern on its way to one of them.

Displays are numbered as the system lists them; on X11 those of all its screens one after the other, also where each display has a
screen of its own. The ramp of a graphics card stands between a pattern's levels and those that leave by the cable.
"""

import ctypes
import itertools
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyglet
from numpy.typing import NDArray

from recon.devices.interfaces import DeviceError, Size
from recon.errors import reason

if TYPE_CHECKING:
    from pyglet.display.base import Screen
    from pyglet.display.xlib import XlibDisplay

pyglet.options.shadow_window = False  # else importing its windows opens one
pyglet.options.dpi_scaling = "real"  # a pixel of a window is one of the display

DEPTH = 24  # bits of colour: 8 of red, green and blue
LEVELS = np.linspace(0, 1, 256)  # of 8 bits


@dataclass(frozen=True)
class Display:
    """A display as the system has set it up."""

    index: int  # by which it is chosen
    name: str  # of its output, such as HDMI-1
    size: Size  # of the desktop on it
    mode: Size  # of the signal that it is sent; the same if nothing is scaled
    position: tuple[int, int]  # of its upper left corner on the desktop, px
    rate_hz: float  # 0 where the system doesn't say
    bits: int = DEPTH  # of colour

    def __str__(self) -> str:
        width, height = self.size
        rate = f", {self.rate_hz:.0f} Hz" if self.rate_hz else ""
        return f"{self.index} ({self.name}, {width}x{height} px at {self.position[0]}, {self.position[1]}{rate})"


def displays() -> list[Display]:
    """All displays.

    Raises
    ------
    DeviceError
        If this session has no desktop.
    """
    with screens() as found:
        return [described(index, screen) for index, screen in enumerate(found)]


@contextmanager
def screens() -> "Iterator[list[Screen]]":
    """What pyglet calls a display, in the order of `displays`, by connections that are closed afterwards.

    Raises
    ------
    DeviceError
        If this session has no desktop.
    """
    with ExitStack() as stack:
        found = list(itertools.chain.from_iterable(_screens_of_desktops(stack)))
        if not found:
            place = os.environ.get("DISPLAY")
            raise DeviceError(
                f"projector: expected a desktop with displays, found {f'none at DISPLAY={place}' if place else 'no DISPLAY'}: "
                "log in at the computer that the projector is connected to, or set DISPLAY, mostly to :0"
            )
        yield found


def chosen(found: Sequence[Display], index: int, size: Size) -> Display:
    """The display of an index, after a check that the projector's pixels are its pixels.

    Raises
    ------
    DeviceError
        If there is no such display, its size isn't the projector's, the graphics card scales it, or it has too few levels.
    """
    listed = "; ".join(map(str, found))
    if not 0 <= index < len(found):
        raise DeviceError(
            f"projector: expected display {index}, found {listed}: is the projector on, and does the desktop extend to it?"
        )
    display, (width, height) = found[index], size
    if display.size != size:
        raise DeviceError(
            f"projector: expected a display of {width}x{height} px, as its patterns have, found display {display}: set this "
            f"resolution, choose another display ({listed}), or take patterns of its size"
        )
    if display.mode != size:
        raise DeviceError(
            f"projector: expected a signal of {width}x{height} px, found one of {display.mode[0]}x{display.mode[1]} px on "
            f"display {display}: the graphics card scales it, which bends patterns; set the scale to 100 %"
        )
    if display.bits < DEPTH:
        raise DeviceError(
            f"projector: expected {DEPTH} bits of colour, found {display.bits} on display {display}: these show fewer levels "
            "than patterns have; set the desktop to 24 bits"
        )
    return display


def described(index: int, screen: "Screen") -> Display:
    """A display by pyglet's."""
    size, mode = (int(screen.width), int(screen.height)), screen.get_mode()
    sent = size if mode is None else (int(mode.width), int(mode.height))
    if sent == size[::-1]:  # turned by a quarter: pixel by pixel all the same
        sent = size
    name = screen.get_monitor_name() or "no name"
    place, rate = (int(screen.x), int(screen.y)), 0.0 if mode is None else float(mode.rate or 0)
    return Display(index, name, size, sent, place, rate, DEPTH if mode is None else int(mode.depth))


def gamma_ramp(screen: Any) -> NDArray[np.float64] | None:
    """Levels that leave the graphics card for even steps of red, green and blue : (3, n), 0 to 1; None where it can't be read.

    It is read on X11. Elsewhere, and behind it in the projector, only a camera can tell: see `projector_response`.
    """
    crtc = getattr(screen, "crtc_id", None)
    if crtc is None:
        return None
    try:
        library = ctypes.CDLL("libXrandr.so.2")
    except OSError:
        return None
    library.XRRGetCrtcGamma.argtypes = [ctypes.c_void_p, ctypes.c_ulong]
    library.XRRGetCrtcGamma.restype = ctypes.POINTER(_Ramp)
    library.XRRFreeGamma.argtypes = [ctypes.POINTER(_Ramp)]
    connection = ctypes.cast(screen.display._display, ctypes.c_void_p)
    ramp = library.XRRGetCrtcGamma(connection, crtc)
    if not ramp:
        return None
    try:
        size = ramp.contents.size
        levels = np.array([getattr(ramp.contents, colour)[:size] for colour in ("red", "green", "blue")]) / 65535
        return levels if levels.any() else None  # a ramp that was never set is all zero
    finally:
        library.XRRFreeGamma(ramp)


def bent_by(ramp: NDArray[np.float64]) -> float:
    """Largest change of a level by a ramp : (3, n), as a share of full scale."""
    even = np.linspace(0, 1, ramp.shape[1])
    return float(max(np.abs(np.interp(LEVELS, even, colour) - LEVELS).max() for colour in ramp))


class _Ramp(ctypes.Structure):
    """XRRCrtcGamma, of Xrandr.h."""

    _fields_ = (
        ("size", ctypes.c_int),
        ("red", ctypes.POINTER(ctypes.c_ushort)),
        ("green", ctypes.POINTER(ctypes.c_ushort)),
        ("blue", ctypes.POINTER(ctypes.c_ushort)),
    )


def _screens_of_desktops(stack: ExitStack) -> "Iterator[Sequence[Screen]]":
    """Screens of pyglet, those of each screen of X11 by a connection of its own, which the stack closes."""
    if not sys.platform.startswith("linux"):
        yield pyglet.display.Display().get_screens()
        return
    try:
        from pyglet.display.xlib import NoSuchDisplayException, XlibDisplay
    except ImportError as error:
        raise DeviceError(f"projector: a library of the system is missing, {reason(error)}: install X11's and OpenGL's") from None
    desktop = re.sub(r"(:\d+)\.\d+$", r"\1", os.environ.get("DISPLAY", ""))  # :0.1 is screen 1 of the desktop :0
    if not desktop:
        return
    for number in itertools.count():
        try:
            connection = XlibDisplay(f"{desktop}.{number}", number)
        except NoSuchDisplayException:
            return
        stack.callback(_disconnect, connection)
        yield connection.get_screens()


def _disconnect(connection: "XlibDisplay") -> None:
    """Close a connection to X11 with what is left of its windows; pyglet keeps it for ever, and a server has room for 256."""
    from pyglet.app.xlib import XlibEventLoop
    from pyglet.libs.x11 import xlib

    cast(XlibEventLoop, pyglet.app.platform_event_loop).select_devices.discard(connection)
    xlib.XCloseDisplay(connection._display)
