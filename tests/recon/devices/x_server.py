"""What may happen to a desktop, on a screen without a monitor."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray
from pyglet.libs.x11 import xlib, xrandr

from twin.experiments import virtual_screen


@contextmanager
def x_server(*screens: str) -> Iterator[str]:
    """A desktop of screens such as 1280x800x24; skips the test where Xvfb isn't installed."""
    if virtual_screen.installed() is None:
        pytest.skip("no Xvfb; `apt-get install xvfb` brings it")
    with virtual_screen.running(*screens) as display:
        yield display


@contextmanager
def connected(display: str) -> Iterator[tuple[ctypes.c_void_p, int]]:
    """A connection to a display such as :7.0, and its root window."""
    connection = xlib.XOpenDisplay(display.encode())
    try:
        yield connection, xlib.XDefaultRootWindow(connection)
    finally:
        xlib.XCloseDisplay(connection)


@contextmanager
def covered(display: str) -> Iterator[None]:
    """Another program's window over a corner of the screen."""
    with connected(display) as (connection, root):
        window = xlib.XCreateSimpleWindow(connection, root, 0, 0, 200, 100, 0, 0, 0xFFFFFF)
        xlib.XMapRaised(connection, window)
        xlib.XSync(connection, 0)
        yield


def move_windows(display: str, x: int, y: int) -> None:
    """Place the topmost window elsewhere, as a window manager does once a display is gone."""
    with connected(display) as (connection, root):
        ignored, windows, count = xlib.Window(), ctypes.POINTER(xlib.Window)(), ctypes.c_uint()
        xlib.XQueryTree(connection, root, ignored, ignored, ctypes.byref(windows), ctypes.byref(count))
        xlib.XMoveWindow(connection, windows[count.value - 1], x, y)
        xlib.XSync(connection, 0)


def set_ramp(display: str, levels: NDArray[np.float64]) -> None:
    """Give the first output a gamma ramp : (256,), 0 to 1, as night light does."""
    library = ctypes.CDLL("libXrandr.so.2")
    library.XRRAllocGamma.restype = ctypes.POINTER(Ramp)
    library.XRRSetCrtcGamma.argtypes = [ctypes.c_void_p, ctypes.c_ulong, ctypes.POINTER(Ramp)]
    with connected(display) as (connection, root):
        ramp = library.XRRAllocGamma(len(levels))
        numbers = np.rint(65535 * levels).astype(np.uint16).tobytes()
        for colour in (ramp.contents.red, ramp.contents.green, ramp.contents.blue):
            ctypes.memmove(colour, numbers, len(numbers))
        crtc = xrandr.XRRGetScreenResources(connection, root).contents.crtcs[0]
        library.XRRSetCrtcGamma(ctypes.cast(connection, ctypes.c_void_p), crtc, ramp)
        xlib.XSync(connection, 0)


def set_output(display: str, size: tuple[int, int], position: tuple[int, int]) -> None:
    """Have the only output show a part of the desktop, as one of several displays does."""
    library = ctypes.CDLL("libXrandr.so.2")
    library.XRRCreateMode.restype = xrandr.RRMode
    library.XRRCreateMode.argtypes = [ctypes.c_void_p, ctypes.c_ulong, ctypes.c_void_p]
    library.XRRAddOutputMode.argtypes = [ctypes.c_void_p, ctypes.c_ulong, ctypes.c_ulong]
    name = b"%dx%d" % size
    mode = xrandr.XRRModeInfo(width=size[0], height=size[1], name=name, nameLength=len(name), dotClock=60 * 2 * size[0] * size[1])
    mode.hTotal, mode.vTotal = 2 * size[0], size[1]
    with connected(display) as (connection, root):
        pointer = ctypes.cast(connection, ctypes.c_void_p)
        made = library.XRRCreateMode(pointer, root, ctypes.byref(mode))
        resources = xrandr.XRRGetScreenResources(connection, root)
        output, crtc = resources.contents.outputs[0], resources.contents.crtcs[0]
        library.XRRAddOutputMode(pointer, output, made)
        xlib.XSync(connection, 0)
        resources = xrandr.XRRGetScreenResources(connection, root)
        outputs = (xrandr.RROutput * 1)(output)
        done = xrandr.XRRSetCrtcConfig(connection, resources, crtc, xlib.CurrentTime, *position, made, 1, outputs, 1)
        assert done == 0
        xlib.XSync(connection, 0)


class Ramp(ctypes.Structure):
    """XRRCrtcGamma, of Xrandr.h."""

    _fields_ = (("size", ctypes.c_int), *((name, ctypes.POINTER(ctypes.c_ushort)) for name in ("red", "green", "blue")))
