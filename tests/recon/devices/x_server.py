"""A screen of X11 without a monitor, screenshots of it, and what may happen to a desktop."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray
from pyglet.libs.x11 import xlib, xrandr

ALL_PLANES, Z_PIXMAP = 0xFFFFFFFFFFFFFFFF, 2  # of Xlib.h


@contextmanager
def x_server(*screens: str) -> Iterator[str]:
    """Run Xvfb with screens such as 1280x800x24, and give its display; skips the test where it isn't installed."""
    program = shutil.which("Xvfb")
    if program is None:
        pytest.skip("no Xvfb; `apt-get install xvfb` brings it")
    receive, send = os.pipe()
    options = [word for number, screen in enumerate(screens) for word in ("-screen", str(number), screen)]
    server = subprocess.Popen(
        [program, "-displayfd", str(send), *options, "-nolisten", "tcp", "-noreset"], pass_fds=(send,), stderr=subprocess.DEVNULL
    )
    os.close(send)
    try:
        with os.fdopen(receive) as answer:
            number = answer.readline().strip()
        if not number:
            pytest.skip("Xvfb does not start here")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait(10)


@contextmanager
def connected(display: str) -> Iterator[tuple[ctypes.c_void_p, int]]:
    """A connection to a display such as :7.0, and its root window."""
    connection = xlib.XOpenDisplay(display.encode())
    try:
        yield connection, xlib.XDefaultRootWindow(connection)
    finally:
        xlib.XCloseDisplay(connection)


def screenshot(display: str) -> NDArray[np.uint8]:
    """The screen of a display : (h, w, 3), blue, green, red."""
    with connected(display) as (connection, root):
        number = xlib.XDefaultScreen(connection)
        width, height = xlib.XDisplayWidth(connection, number), xlib.XDisplayHeight(connection, number)
        image = xlib.XGetImage(connection, root, 0, 0, width, height, ALL_PLANES, Z_PIXMAP).contents
        place = ctypes.c_void_p.from_buffer(image, type(image).data.offset)
        levels = np.frombuffer(ctypes.string_at(place.value, image.bytes_per_line * height), np.uint8)
        xlib.XFree(place)
        return levels.reshape(height, -1, 4)[:, :width, :3]


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
