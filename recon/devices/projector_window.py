"""A projector as a second display: a window without border over all of it, that shows each pattern pixel by pixel.

A pattern is drawn by OpenGL, read back and compared, and shown with the display's next image (vertical synchronisation). Then the
cable, the projector's own electronics and its lamp take their time; `projector_delay` measures it with a camera.
"""

import contextlib
import logging
import os
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pyglet
from numpy.typing import NDArray

from recon.devices import displays
from recon.devices.displays import Display
from recon.devices.interfaces import DeviceError, Size
from recon.errors import reason

if TYPE_CHECKING:
    from pyglet.display.base import Screen

log = logging.getLogger(__name__)

Pattern = NDArray[np.uint8]

DELAY_S = 0.1  # from drawing to light, if it wasn't measured: projectors take up to five images of 1/60 s


class ProjectorWindow:
    """A projector at a display of this computer, as `interfaces.Projector`.

    Parameters
    ----------
    size : (width, height), px
        Of the projector, and of its patterns.
    display : int
        Index among `displays.displays()`.
    delay_s : float
        From drawing to light, by `projector_delay`; `show` waits for it.

    Raises
    ------
    DeviceError
        If the display isn't there, has another size, is scaled, or the window doesn't cover exactly it.
    """

    def __init__(self, size: Size, display: int, delay_s: float = DELAY_S) -> None:
        self.size = size
        self.delay_s = delay_s
        self._closing = threading.Event()
        self._thread = ThreadPoolExecutor(1, "projector")  # the one thread that OpenGL and the window belong to
        opening = self._thread.submit(_Canvas, size, display)
        with ExitStack() as stack:
            stack.callback(self._thread.shutdown)
            stack.callback(self._give_back, opening)
            self._canvas = opening.result()
            self._pump = threading.Thread(target=self._keep_alive, name="projector messages", daemon=True)
            self._pump.start()
            self._open = stack.pop_all()

    @property
    def display(self) -> Display:
        """The display that it is on."""
        return self._canvas.display

    def show(self, pattern: Pattern) -> int:
        """Show a pattern : (h, w), and wait until it is on the screen.

        Returns
        -------
        int
            Time in ns of this computer's monotonic clock from which on the pattern is on the screen as a whole.

        Raises
        ------
        DeviceError
            If the pattern isn't of the projector's size, came out other than drawn, or the window is gone or elsewhere.
        """
        if self._closing.is_set():
            raise DeviceError("projector: expected an open window, found a closed one")
        drawn_ns = self._thread.submit(self._canvas.draw, pattern).result()
        lit_ns = drawn_ns + round(1e9 * self.delay_s)
        time.sleep(max(lit_ns - time.monotonic_ns(), 0) / 1e9)
        return lit_ns

    def close(self) -> None:
        """Darken the screen and give it back."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._pump.join()
        self._open.close()

    def _give_back(self, opening: "Future[_Canvas]") -> None:
        """Close the window, if it was opened, also where nobody waited for it to the end."""
        if opening.exception() is None:
            self._thread.submit(opening.result().close).result()

    def _keep_alive(self) -> None:
        # between looks at the system's messages; a window that leaves them unread for seconds is covered by some systems
        pump_s = 0.1
        while not self._closing.wait(pump_s):
            with contextlib.suppress(RuntimeError):  # Python ends, and nobody has closed the window
                self._thread.submit(self._canvas.read_messages)


class _Canvas:
    """The window and what is drawn in it; all in one thread."""

    def __init__(self, size: Size, index: int) -> None:
        with ExitStack() as stack:
            screens = stack.enter_context(displays.screens())
            found = [displays.described(each, screen) for each, screen in enumerate(screens)]
            self.display = displays.chosen(found, index, size)
            _warn_of_bending(screens[index], self.display)
            self._window = _opened(screens[index], self.display)
            stack.callback(self._window.close)
            self._window.push_handlers(on_key_press=_ignored, on_close=_ignored, on_expose=self._redraw)
            self._window.set_mouse_visible(False)
            self._texture = pyglet.image.Texture.create(
                *size, min_filter=pyglet.gl.GL_NEAREST, mag_filter=pyglet.gl.GL_NEAREST, blank_data=True
            )
            self._wait_for_place()
            self.draw(np.zeros(size[::-1], np.uint8))
            self._open = stack.pop_all()

    def draw(self, pattern: Pattern) -> int:
        """Draw a pattern, check it and show it; the time in ns after the exchange of images."""
        width, height = self.display.size
        if pattern.shape != (height, width) or pattern.dtype != np.uint8:
            raise DeviceError(f"projector: expected patterns of {width}x{height} px of 8 bits, found {_kind(pattern)}")
        self._window.switch_to()
        self.read_messages()
        self._check_place()
        upwards = cv2.cvtColor(np.ascontiguousarray(pattern[::-1]), cv2.COLOR_GRAY2RGBA)
        self._texture.blit_into(pyglet.image.ImageData(width, height, "RGBA", upwards.tobytes()), 0, 0, 0)
        self._paint()
        self._check_pixels(upwards)
        self._window.flip()
        pyglet.gl.glFinish()
        return time.monotonic_ns()

    def read_messages(self) -> None:
        """Answer the system's messages to the window."""
        self._window.dispatch_events()

    def close(self) -> None:
        """Darken the screen, and close window and connection in any case."""
        with self._open:
            self._window.switch_to()
            self._window.clear()
            self._window.flip()

    def _paint(self) -> None:
        self._window.clear()
        self._texture.blit(0, 0)

    def _redraw(self) -> None:
        """Show the pattern again after something has covered it."""
        self._window.switch_to()
        self._paint()
        self._window.flip()

    def _check_pixels(self, upwards: Pattern) -> None:
        """Compare what OpenGL has drawn with the pattern : (h, w, 4), the lowest row first."""
        height, width = upwards.shape[:2]
        drawn = np.empty_like(upwards)
        pyglet.gl.glReadPixels(0, 0, width, height, pyglet.gl.GL_RGBA, pyglet.gl.GL_UNSIGNED_BYTE, drawn.ctypes.data)
        if not np.array_equal(drawn[..., :3], upwards[..., :3]):
            off = cv2.absdiff(drawn, upwards)[..., :3].max(axis=2)
            raise DeviceError(
                f"projector: expected the pattern's pixels on display {self.display}, found {np.count_nonzero(off)} others, by "
                f"up to {off.max()} of 255: is the display set to less than 24 bits of colour, or does something cover it?"
            )

    def _wait_for_place(self) -> None:
        """Give the window manager its time."""
        opening_s = 2.0  # that a window manager may take to place the window
        end = time.monotonic() + opening_s
        while self._misplaced() and time.monotonic() < end:
            self.read_messages()
            time.sleep(0.01)
        self._check_place()

    def _check_place(self) -> None:
        if where := self._misplaced():
            raise DeviceError(
                f"projector: expected its window on display {self.display}, found {where}: was the projector unplugged or the "
                "desktop changed, or does the window manager place windows by itself? Set up the display and begin anew"
            )

    def _misplaced(self) -> str:
        """The window's place and size where they aren't the display's, else nothing."""
        place, size, pixels = self._window.get_location() or (0, 0), self._window.get_size(), self._window.get_framebuffer_size()
        if place == self.display.position and size == pixels == self.display.size:
            return ""
        scaled = "" if size == pixels else f", drawn by {pixels[0]}x{pixels[1]} px"
        return f"it at {place[0]}, {place[1]} with {size[0]}x{size[1]} px{scaled}"


def _opened(screen: "Screen", display: Display) -> "pyglet.window.Window":
    """A window over a whole display, by images of 8 bits or more a colour."""
    try:
        from pyglet import gl, window
    except ImportError as error:  # of OpenGL itself
        raise DeviceError(f"projector: a library of the system is missing, {reason(error)}: install OpenGL (libgl1)") from None
    config = gl.Config(double_buffer=True, red_size=8, green_size=8, blue_size=8, depth_size=0, stencil_size=0)
    try:
        return window.Window(
            fullscreen=True, screen=screen, display=screen.display, config=config, vsync=True, caption="projector"
        )
    except (window.WindowException, gl.ContextException) as error:
        raise DeviceError(
            f"projector: expected OpenGL 3.3 with 24 bits of colour on display {display}, found {reason(error)}: install the "
            "graphics card's driver or Mesa (libgl1), and set the display to 24 bits"
        ) from None


def _warn_of_bending(screen: "Screen", display: Display) -> None:
    """Log what bends patterns but may be wanted, and what cannot be checked."""
    ramp = displays.gamma_ramp(screen)
    bent = 2 / 255  # of full scale, by which a ramp may move a level
    if ramp is None:
        log.info("projector: the graphics card's ramp of display %s can't be read here; measure grey steps by a camera", display)
    elif (off := displays.bent_by(ramp)) > bent:
        log.warning(
            "projector: the graphics card's ramp of display %s moves levels by up to %.0f of 255: switch off night light and "
            "colour profiles of this display, unless the ramp is there to make the projector linear",
            display,
            255 * off,
        )
    if os.environ.get("WAYLAND_DISPLAY"):
        log.warning("projector: Wayland may scale and delay what display %s shows; log in to a session of X11", display)


def _ignored(*_: object) -> bool:
    """Leave a key or a wish to close the window without effect: a sequence must not end by Escape on another display."""
    return True  # handled


def _kind(pattern: NDArray) -> str:
    height, width = (*pattern.shape, 0, 0)[:2]
    return f"{width}x{height} px" if pattern.dtype == np.uint8 and pattern.ndim == 2 else f"{pattern.shape} {pattern.dtype}"
