"""A view in the browser: skin, masses, probe and B-scan in space, with distances, latency and what is wrong, as they come."""

import socket
from contextlib import redirect_stdout
from io import StringIO
from time import monotonic

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import Moment, StillScene

Array = NDArray[np.float64]

LOOPBACK = "127.0.0.1"
M = 0.001  # the view is in metres: its nearest and farthest depth suit them
SKIN, MASS, CUT, BODY, INK = (224, 187, 165), (200, 60, 60), (255, 210, 60), (235, 235, 235), (20, 20, 20)
WORDS_S = 0.2  # between two texts: faster ones can't be read
AWAY_MM = (-180.0, -130.0, -330.0)  # from the scene's middle to the viewer, in the world: camera 1's side, from above
AHEAD_MM = 680.0  # from camera 1 to the scene's middle, where there is neither skin nor mass
QUALITY = 85  # of JPEG


class BrowserView:
    """A publisher that serves a page; whoever opens it sees the newest moment, and a slow browser fewer of them."""

    name = "browser"

    def __init__(self, scene: StillScene, port: int = 8080, host: str = LOOPBACK) -> None:
        """Serve the page of a scene. InputError if the port can't be had; ModuleNotFoundError without viser."""
        import viser  # of the extra `live`

        _check_free(host, port)
        with redirect_stdout(StringIO()):  # it prints, even so
            self._server = viser.ViserServer(host=host, port=port, label="sonotwin", verbose=False)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._bodies = _add_scene(self._server, scene)
        self._scan = None  # handle of the image, as soon as there is one
        self._shown: PlacedScan | None = None
        self._outlines = {}
        self._words, self._written = self._server.gui.add_markdown("waiting for the first frames"), 0.0

    @property
    def address(self) -> str:
        """Of the page."""
        host = self._server.get_host()
        return f"http://{'localhost' if host == LOOPBACK else host}:{self._server.get_port()}"

    def publish(self, moment: Moment) -> None:
        """Show a moment; see `Publisher`."""
        with self._server.atomic():
            self._show_probe(moment.world_from_target)
            self._show_scan(moment)
        if monotonic() - self._written > WORDS_S:
            self._words.content, self._written = words_of(moment), monotonic()
        self._server.flush()

    def close(self) -> None:
        """End."""
        with redirect_stdout(StringIO()):
            self._server.stop()

    def _show_probe(self, world_from_target: Array | None) -> None:
        self._bodies.visible = world_from_target is not None
        if world_from_target is not None:
            self._bodies.wxyz, self._bodies.position = turn_of(world_from_target), world_from_target[:3, 3] * M

    def _show_scan(self, moment: Moment) -> None:
        scan = moment.scan
        if scan is not None and scan is not self._shown:
            self._place(scan)
            self._draw_outlines(moment)
        for handle in (self._scan, *self._outlines.values()):
            if handle is not None:
                handle.visible = scan is not None
        self._shown = scan

    def _place(self, scan: PlacedScan) -> None:
        """Show a B-scan where it was taken, to the borders of its outer pixels."""
        (height, width), colour = scan.image.shape, cv2.cvtColor(scan.image, cv2.COLOR_GRAY2RGB)
        middle, turn = scan.corners.mean(axis=0) * M, turn_of(scan.world_from_pixel)
        image = self._scan
        if image is None:
            across, down = np.linalg.norm(scan.world_from_pixel[:3, :2], axis=0) * M
            image = self._server.scene.add_image(
                "/scan", colour, width * across, height * down, jpeg_quality=QUALITY, cast_shadow=False, receive_shadow=False
            )
        else:
            image.image = colour
        image.wxyz, image.position = turn, middle
        self._scan = image

    def _draw_outlines(self, moment: Moment) -> None:
        for each in moment.distances:
            if each.name in self._outlines:
                self._outlines.pop(each.name).remove()
            if each.cut:
                self._outlines[each.name] = self._server.scene.add_line_segments(
                    f"/outlines/{each.name}", each.outline * M, CUT, thickness=2.0, thickness_units="screen"
                )


def turn_of(to_from: Array) -> Array:
    """Quaternion : (4,) wxyz of the directions of a matrix : (4, 4), whose first two columns may have any length."""
    x, y = (to_from[:3, axis] / np.linalg.norm(to_from[:3, axis]) for axis in (0, 1))
    return np.roll(Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)])).as_quat(), 1)


def words_of(moment: Moment) -> str:
    """The text of a moment, as Markdown."""
    lines = [f"**{'Tracking' if moment.world_from_target is not None else 'Not tracking'}:** {moment.state}"]
    lines += [f"**Device:** {trouble}" for trouble in moment.troubles]
    if moment.latency is not None:
        late = moment.latency
        lines.append(f"**From exposure to published pose:** {late.median_ms:.0f} ms, 99 % below {late.high_ms:.0f} ms")
        lines.append(f"**Poses:** {late.rate_hz:.0f} a second")
    lines.append("**B-scan:** in place" if moment.scan is not None else "**B-scan:** none in place")
    if moment.distances:
        rows = [f"| {each.name} | {each.distance_mm:.1f} | {_where(each.cut, each.in_image)} |" for each in moment.distances]
        lines.append("\n".join(["| mass | plane, mm | |", "|---|---:|---|", *rows]))
    return "\n\n".join(lines)


def _where(cut: bool, in_image: bool) -> str:
    if not cut:
        return ""
    return "cut, in the image" if in_image else "cut beside the image"


def _add_scene(server, scene: StillScene):
    """Add what stands still; returns the handle of the probe, which moves."""
    for name, mesh, colour, opacity in (
        ("skin", scene.skin, SKIN, 0.45),
        *((f"masses/{name}", mesh, MASS, 0.7) for name, mesh in scene.masses.items()),
    ):
        if mesh is not None:
            _add_mesh(server, f"/{name}", mesh, colour, opacity)
    handle = server.scene.add_frame("/probe", show_axes=False, visible=False)
    for name, mesh, colour in (("body", scene.probe, BODY), ("circles", scene.circles, INK)):
        if mesh is not None:
            _add_mesh(server, f"/probe/{name}", mesh, colour, None)
    server.scene.set_up_direction((0.0, -1.0, 0.0))
    middle = _middle(scene)
    server.initial_camera.look_at = middle * M
    server.initial_camera.position = (middle + AWAY_MM) * M
    server.initial_camera.up = (0.0, -1.0, 0.0)
    return handle


def _add_mesh(server, name: str, mesh: trimesh.Trimesh, colour: tuple[int, int, int], opacity: float | None) -> None:
    vertices = np.asarray(mesh.vertices) * M
    server.scene.add_mesh_simple(
        name, vertices, np.asarray(mesh.faces), color=colour, opacity=opacity, side="double", cast_shadow=False
    )


def _middle(scene: StillScene) -> Array:
    known = [mesh for mesh in (scene.skin, *scene.masses.values()) if mesh is not None]
    return np.array([0.0, 0.0, AHEAD_MM]) if not known else np.asarray(known[0].bounds, float).mean(axis=0)


def _check_free(host: str, port: int) -> None:
    """Refuse a port that another program has: the server would silently take the next."""
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, port))
        except OSError as error:
            found = f"found it refused: {error.strerror}; give another view.port, or close the other program"
            raise InputError(f"view: expected to listen on {host}:{port}, {found}") from None
