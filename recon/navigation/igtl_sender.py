"""The OpenIGTLink server as a sender of moments."""

import numpy as np
from numpy.typing import NDArray

from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_messages import Message, Text, Transform
from recon.devices.openigtlink.igtl_model import Model
from recon.devices.openigtlink.igtl_server import Server

Array = NDArray[np.float64]


class IgtlSender:
    """A `recon.navigation.slicer_publisher.Sender` that publishes by a server, and closes it in the end."""

    def __init__(self, server: Server) -> None:
        self._server = server

    def transform(self, name: str, ras_from_frame: Array, time_ns: int) -> None:
        """Send a transform : (4, 4) mm."""
        self._server.publish(Message(name, Transform(ras_from_frame), time_ns))

    def image(self, name: str, levels: NDArray[np.uint8], ras_from_index: Array, time_ns: int) -> None:
        """Send an image : (h, w) in its place."""
        self._server.publish(Message(name, Image(levels, ras_from_index), time_ns))

    def model(self, name: str, points: Array, triangles: NDArray[np.int64]) -> None:
        """Send a surface."""
        self._server.publish(Message(name, Model(points, triangles)))

    def text(self, name: str, text: str, time_ns: int) -> None:
        """Send a line of text."""
        self._server.publish(Message(name, Text(text), time_ns))

    def close(self) -> None:
        """Listen no more."""
        self._server.close()
