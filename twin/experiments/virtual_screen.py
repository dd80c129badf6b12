"""A screen of X11 without a monitor, and screenshots of it: what a second display would be sent."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import DeviceError

ALL_PLANES, Z_PIXMAP = 0xFFFFFFFFFFFFFFFF, 2  # of Xlib.h
STOPPING_S = 10.0


def installed() -> str | None:
    """The path of Xvfb, or None."""
    return shutil.which("Xvfb")


@contextmanager
def running(*screens: str) -> Iterator[str]:
    """Run Xvfb with screens such as 1280x800x24, and give the name of its desktop, such as :7.

    Raises
    ------
    DeviceError
        If it isn't installed or doesn't start.
    """
    receive, send = os.pipe()
    options = [word for number, screen in enumerate(screens) for word in ("-screen", str(number), screen)]
    command = [installed() or "Xvfb", "-displayfd", str(send), *options, "-nolisten", "tcp", "-noreset"]
    with os.fdopen(receive) as answer:
        try:
            server = subprocess.Popen(command, pass_fds=(send,), stderr=subprocess.DEVNULL)
        except FileNotFoundError:
            raise DeviceError("Xvfb: expected a virtual screen, found none installed; `apt-get install xvfb` brings it") from None
        finally:
            os.close(send)
        try:
            number = answer.readline().strip()
            if not number:
                raise DeviceError(f"Xvfb: expected screens of {', '.join(screens)}, found an end with {server.wait(STOPPING_S)}")
            yield f":{number}"
        finally:
            server.terminate()
            server.wait(STOPPING_S)


def screenshot(display: str) -> NDArray[np.uint8]:
    """A screen such as :7.0 : (h, w, 3), blue, green, red."""
    x11 = _library()
    connection = x11.XOpenDisplay(display.encode())
    number = x11.XDefaultScreen(connection)
    width, height = x11.XDisplayWidth(connection, number), x11.XDisplayHeight(connection, number)
    root = x11.XDefaultRootWindow(connection)
    image = x11.XGetImage(connection, root, 0, 0, width, height, ALL_PLANES, Z_PIXMAP)
    stride = image.contents.bytes_per_line
    levels = np.frombuffer(ctypes.string_at(image.contents.data, stride * height), np.uint8)
    x11.XFree(image.contents.data)
    x11.XFree(image)
    x11.XCloseDisplay(connection)
    return levels.reshape(height, stride // 4, 4)[:, :width, :3]


def _library() -> ctypes.CDLL:
    """Xlib, with pointers as such."""
    x11 = ctypes.CDLL("libX11.so.6")
    pointer, number = ctypes.c_void_p, ctypes.c_int
    x11.XOpenDisplay.restype = pointer
    x11.XDefaultRootWindow.restype = ctypes.c_ulong
    x11.XGetImage.restype = ctypes.POINTER(_XImage)
    x11.XDefaultScreen.argtypes = x11.XDefaultRootWindow.argtypes = x11.XCloseDisplay.argtypes = x11.XFree.argtypes = [pointer]
    x11.XDisplayWidth.argtypes = x11.XDisplayHeight.argtypes = [pointer, number]
    x11.XGetImage.argtypes = [pointer, ctypes.c_ulong, number, number, ctypes.c_uint, ctypes.c_uint, ctypes.c_ulong, number]
    return x11


class _XImage(ctypes.Structure):
    """The beginning of XImage, of Xlib.h."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("width", "height", "xoffset", "format")),
        ("data", ctypes.c_void_p),
        *((name, ctypes.c_int) for name in ("byte_order", "unit", "bit_order", "pad", "depth", "bytes_per_line")),
    )
