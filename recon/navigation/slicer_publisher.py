"""Moments for 3D Slicer over OpenIGTLink: what it shows at once, without any setting.

Slicer puts whatever comes into its own frame RAS, from which the world is half a turn: the same as of files declared LPS
(`recon.freehand.sequences`). So everything is sent in RAS: the transforms of target and image, of further bodies and of tools'
tips, each B-scan with its pose, skin and masses as models, and lines of text. Transforms have PLUS's names, `FromToTo`.
"""

import logging
from collections.abc import Iterable, Sequence
from time import monotonic_ns, time_ns
from typing import Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.devices.openigtlink.igtl_header import MOST_NAME_BYTES
from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_messages import Message, Text, Transform
from recon.devices.openigtlink.igtl_model import Model
from recon.devices.openigtlink.igtl_server import Server
from recon.errors import short
from recon.freehand.sequences import RAS_FROM_LPS
from recon.geometry import rigid
from recon.model.tip import Tip
from recon.navigation import tool_figures
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import Moment, StillScene
from recon.navigation.tool_figures import Alarms

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
TARGET, PROBE = "TargetToRAS", "ProbeToRAS"
SCAN, STATUS, SKIN, DISTANCES, TOOLS = "BScan", "Status", "Skin", "Distances", "Tools"
PROBE_BODY = "Probe"  # a model in the target's frame, to be put under its transform
OWN = (TARGET, PROBE, SCAN, STATUS, SKIN, DISTANCES, PROBE_BODY)
OWN_FRAMES = ("Target", PROBE_BODY)
MOST_FRAME_BYTES = MOST_NAME_BYTES - len("TipToRAS")


class Sender(Protocol):
    """An OpenIGTLink server: gives each name's newest message to its clients, at once to those that connect later."""

    def transform(self, name: str, ras_from_frame: Array, time_ns: int) -> None:
        """Send a transform : (4, 4) mm; times in ns since 1970."""

    def image(self, name: str, levels: NDArray[np.uint8], ras_from_index: Array, time_ns: int) -> None:
        """Send an image : (h, w), and the matrix : (4, 4) that takes [u, v, 0, 1] of its pixels' centres to mm."""

    def model(self, name: str, points: Array, triangles: NDArray[np.int64]) -> None:
        """Send a surface of points : (n, 3) mm, and triangles : (m, 3)."""

    def text(self, name: str, text: str, time_ns: int) -> None:
        """Send a line of text."""

    def close(self) -> None:
        """End."""


class SlicerPublisher:
    """A publisher that sends moments to 3D Slicer."""

    name = "OpenIGTLink"

    def __init__(self, scene: StillScene, sender: Sender, alarms: Alarms | None = None) -> None:
        self._sender, self._scene, self._alarms = sender, scene, alarms or Alarms()
        self._since_1970 = time_ns() - monotonic_ns()
        self._sent: PlacedScan | None = None
        self._status = self._tools = ""
        self._frames: dict[str, str] = {}  # of further bodies
        if scene.skin is not None:
            self._send_model(SKIN, scene.skin, RAS_FROM_LPS)
        for name, mesh in zip(_distinct_names(scene.masses, OWN), scene.masses.values(), strict=True):
            self._send_model(name, mesh, RAS_FROM_LPS)
        if scene.probe is not None:
            self._send_model(PROBE_BODY, scene.probe, np.eye(4))

    def publish(self, moment: Moment) -> None:
        """Send a moment; see `Publisher`. What hasn't changed isn't sent again."""
        now = moment.exposed_ns + self._since_1970
        if moment.world_from_target is not None:
            ras_from_target = RAS_FROM_LPS @ moment.world_from_target
            self._sender.transform(TARGET, ras_from_target, now)
            self._sender.transform(PROBE, ras_from_target @ self._scene.target_from_image, now)
        self._send_bodies(moment, now)
        if moment.scan is not None and moment.scan is not self._sent:
            self._sent = moment.scan
            taken = moment.scan.taken_ns + self._since_1970
            self._sender.image(SCAN, moment.scan.image, RAS_FROM_LPS @ moment.scan.world_from_pixel, taken)
            self._sender.text(DISTANCES, _distances_line(moment), taken)
        if moment.status != self._status:
            self._status = moment.status
            self._sender.text(STATUS, self._status, now)

    def close(self) -> None:
        """End."""
        self._sender.close()

    def _send_bodies(self, moment: Moment, now: int) -> None:
        """Send the bodies that are seen, tools' tips, and a line of the tools."""
        if moment.bodies and not self._frames:
            names = [body.name for body in moment.bodies]
            self._frames = dict(zip(names, _distinct_names(names, OWN_FRAMES, MOST_FRAME_BYTES), strict=True))
        for body in moment.bodies:
            if body.world_from_body is not None:
                ras_from_body = RAS_FROM_LPS @ body.world_from_body
                self._sender.transform(f"{self._frames[body.name]}ToRAS", ras_from_body, now)
                if (tip := self._scene.tools.get(body.name)) is not None:
                    self._sender.transform(f"{self._frames[body.name]}TipToRAS", ras_from_body @ body_from_tip(tip), now)
        if self._scene.tools and (line := tool_figures.line_of(moment, self._scene, self._alarms)) != self._tools:
            self._tools = line
            self._sender.text(TOOLS, line, now)

    def _send_model(self, name: str, mesh: trimesh.Trimesh, ras_from_mesh: Array) -> None:
        self._sender.model(name, rigid.apply(ras_from_mesh, np.asarray(mesh.vertices)), np.asarray(mesh.faces, np.int64))


def body_from_tip(tip: Tip) -> Array:
    """Frame : (4, 4) mm of a tip in its body's: the origin at the tip, z along the shaft, x as near to the body's as can be.

    Where z is the body's x, y is; where the shaft's direction isn't known, directions are the body's. Source: PLUS, *StylusTip*.
    """
    if tip.axis is None:
        return rigid.transform(np.eye(3), tip.tip_mm)
    z, parallel = tip.axis / np.linalg.norm(tip.axis), 1 - 1e-6  # cosine
    y = np.cross(z, [1.0, 0.0, 0.0]) if abs(z[0]) < parallel else np.array([0.0, 1.0, 0.0]) - z * z[1]
    y /= np.linalg.norm(y)
    return rigid.transform(np.column_stack([np.cross(y, z), y, z]), tip.tip_mm)


def _distinct_names(given: Iterable[str], taken: Sequence[str], most_bytes: int = MOST_NAME_BYTES) -> list[str]:
    """Names of masses or bodies as Slicer gets them: short enough for a message, distinct from each other and from what is taken.

    A name that isn't sent as it is but for a capital is logged.
    """
    names: list[str] = []
    for one in given:
        whole = (one[:1].upper() + one[1:]).encode(errors="replace").decode()  # a file's name may hold what is no text
        name, number = _shorten(whole, most_bytes), 1
        while name in taken or name in names:
            number += 1
            name = _shorten(whole, most_bytes, f"~{number}")
        if name != whole:
            why = f"its name is taken, or longer than {most_bytes} bytes"
            log.warning("OpenIGTLink: %s is sent as %s: %s", short(one), name, why)
        names.append(name)
    return names


def _shorten(name: str, most_bytes: int, end: str = "") -> str:
    """A name with an end, of at most so many bytes."""
    return name.encode()[: most_bytes - len(end)].decode(errors="ignore") + end


def _distances_line(moment: Moment) -> str:
    """Distances of the B-scan's plane from the masses, as one line."""
    return "; ".join(f"{each.name} {each.distance_mm:.1f} mm{', cut' * each.cut}" for each in moment.distances)


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
