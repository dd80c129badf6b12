"""An ultrasound scanner whose B-scans come over OpenIGTLink: from PLUS, or from scanners that send it themselves."""

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import DeviceError, Frame
from recon.devices.openigtlink.igtl_client import Client, Received
from recon.devices.openigtlink.igtl_header import Header
from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_server import LOOPBACK, PORT
from recon.devices.scan_view import ScanView
from recon.errors import InputError, short

FIRST_S = 5.0  # in which an image must come after the scanner was opened


class IgtlScanner:
    """A `Scanner`. Lost connections are made anew; meanwhile `frame` raises DeviceError, and gives images again afterwards.

    The time of a frame is the sender's time stamp, in ns since 1970, or its arrival here where the sender gives none.
    """

    def __init__(
        self,
        name: str = "us",
        host: str = LOOPBACK,
        port: int = PORT,
        device: str | None = None,
        view: ScanView | None = None,
        bits: int = 8,
        check: bool = True,
        first_s: float = FIRST_S,
    ) -> None:
        """Connect, and wait for an image.

        device : name of the images, such as Image or Image_Reference; None takes those of the first that comes
        bits : of grey levels that come as 16-bit numbers; the upper eight are taken
        check : whether checksums must be right

        Raises
        ------
        DeviceError
            If none comes in time; the message says what came instead.
        """
        depths = (8, 16)  # bits of grey levels
        if not depths[0] <= bits <= depths[1]:
            raise DeviceError(f"scanner {name}: bits: expected {depths[0]} to {depths[1]}, found {bits}")
        self.name, self._device, self._view, self._bits = name, device, view or ScanView(), bits
        self._client = Client(host, port, self._is_ours, check=check)
        first = self._client.receive(first_s)
        if first is None:
            fault = self._fault(f"an image within {first_s:g} s", self._instead())
            self._client.close()
            raise fault
        self._device = first.message.device
        try:
            grey = self._grey(first)
            self._sent = grey.shape
            self.size = self._view.size((grey.shape[1], grey.shape[0]))
        except InputError:  # of the view, too
            self._client.close()
            raise

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next B-scan : (h, w) uint8; None if none came in time.

        Raises
        ------
        DeviceError
            If there is no connection, or the images have changed their size.
        """
        received = self._client.receive(timeout_s)
        while received is not None and received.message.device != self._device:  # came before it was known which ones are ours
            received = self._client.receive(timeout_s)
        if received is None:
            if self._client.connected:
                return None
            raise self._fault("images", f"{self._client.state}; it is connected to again as soon as it answers")
        grey = self._grey(received)
        if grey.shape != self._sent:
            expected = f"images of {self._sent[1]}x{self._sent[0]} px, as the first one"
            raise self._fault(expected, f"{grey.shape[1]}x{grey.shape[0]}: another preset or depth? open it again")
        image = self._view.of(grey)
        image.flags.writeable = False
        stamp = received.message.time_ns
        return Frame(image, received.number, received.arrived_ns if stamp is None else stamp, received.arrived_ns)

    def close(self) -> None:
        """Give the scanner back."""
        self._client.close()

    def _is_ours(self, header: Header) -> bool:
        return header.kind == "IMAGE" and self._device in (None, header.device)

    def _grey(self, received: Received) -> NDArray[np.uint8]:
        """Grey levels : (h, w) of an image of a plane: of colours the luminance, of many bits the upper eight."""
        content = received.message.content
        if not isinstance(content, Image):
            raise self._fault("an image", "an empty one")
        levels = content.plane
        if content.levels.ndim > 2 and len(content.levels) > 1:
            raise self._fault("images of one plane", f"volumes of {len(content.levels)}")
        if levels.dtype.kind not in "ui" or levels.dtype.itemsize > 2 or (levels.ndim == 3 and levels.shape[2] not in (3, 4)):
            found = f"{levels.dtype.name} of shape {levels.shape}: radio-frequency data?"
            raise self._fault("grey or coloured levels of 8 or 16 bits", f"{found} let the source send B-mode images")
        if levels.dtype.itemsize == 2:
            levels = np.clip(levels >> (self._bits - 8), 0, 255)
        plain = np.ascontiguousarray(levels, np.uint8)
        return plain if plain.ndim == 2 else np.asarray(cv2.cvtColor(plain[..., :3].copy(), cv2.COLOR_RGB2GRAY), np.uint8)

    def _instead(self) -> str:
        seen, fault = self._client.seen, self._client.fault
        if not seen:
            return f"{fault or 'nothing'}: is the source running and sending, on this port?"
        others = "give device=..." if any(name.startswith("IMAGE") for name in seen) else "let the source send IMAGE"
        return f"{short(', '.join(seen), 200)}; {fault or others}"

    def _fault(self, expected: str, found: str) -> DeviceError:
        device = f" {short(self._device)!r}" if self._device else ""
        return DeviceError(f"scanner {self.name} at {self._client.name}{device}: expected {expected}, found {found}")
