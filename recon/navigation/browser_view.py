"""A view in the browser: skin, masses, probe, tools and B-scan in space, with distances, latency and faults, as they come."""

import socket
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from io import StringIO
from time import monotonic

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.fusion.palette import IN_SPACE
from recon.geometry import rigid
from recon.navigation import moment_figures, tool_figures
from recon.navigation.mass_distances import MassDistance
from recon.navigation.own_pages import own_pages_alone
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import BodyAt, Moment, StillScene
from recon.navigation.seen_so_far import SeenSoFar
from recon.navigation.tool_figures import Alarms
from recon.own_requests import LOOPBACK
from recon.segmentation.seen_map import WELL

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

TOOL, PLAN = (90, 205, 255), (120, 230, 120)  # colours of tools, in space and in the B-scan, and of the planned path
HALF_WELL = WELL / 2  # from which what is still to be scanned is paler
UNSEEN, HALF_SEEN, POINT_MM = (240, 150, 40), (250, 225, 150), 0.5  # colours and size of points that are still to be scanned
PLAN_MM, AIM_MM = 0.5, 2.0  # radii of the path's line and of its aim
M = 0.001  # the view is in metres: its nearest and farthest depth suit them
FONT, NAME_GAP_PX = (cv2.FONT_HERSHEY_SIMPLEX, 0.5), 4  # of the names, and between them and the outlines
MARK_PX, FAR_PX = 5, 1e4  # half a crossing's mark; from a picture, beyond which nothing is drawn
PANEL_PX = 290  # width of the figures, beside the view
ASIDE = np.array([-0.5, -0.6, -0.7]) / np.sqrt(1.1)  # direction from the scene to the viewer: camera 1's side, from above
FIELD_RAD, DISTANCE = 0.8, 3.0  # of the view, upright; and from where, as a multiple of the scene's half diagonal
SPACE_MM = np.array([[-100.0, -100.0, 600.0], [100.0, 100.0, 760.0]])  # that is looked at where there is neither skin nor mass


class BrowserView:
    """A publisher that serves a page; whoever opens it sees the newest moment, and a slow browser fewer of them."""

    name = "browser"

    def __init__(self, scene: StillScene, port: int = 8080, host: str = LOOPBACK, alarms: Alarms | None = None) -> None:
        """Serve the page of a scene; a port of 0 takes any that is free.

        Raises
        ------
        InputError
            If the port can't be had.
        ModuleNotFoundError
            Without viser.
        """
        import viser  # of the extra `live`

        free = _free_port(host, port)
        self._scan: viser.ImageHandle | None = None  # of the B-scan in space, as soon as there is one
        self._shown: PlacedScan | None = None
        self._picture: Picture | None = None  # of that
        self._seen: SeenSoFar | None = None
        self._unseen: viser.PointCloudHandle | None = None  # places that are still to be scanned
        self._scene, self._alarms = scene, alarms or Alarms()
        with ExitStack() as stack:
            with own_pages_alone(host), redirect_stdout(StringIO()):  # it prints, even so
                self._server = viser.ViserServer(host=host, port=free, label="sonotwin", verbose=False)
                stack.callback(self.close)
            self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
            self._server.gui.main_panel.dock_right()  # beside the view, where it covers nothing
            self._server.gui.main_panel.set_width(PANEL_PX)
            self._probe = _add_scene(self._server, scene)
            self._tools = {name: _add_tool(self._server, name, mesh) for name, mesh in scene.shapes.items()}
            self._server.gui.add_html(moment_figures.STYLE)
            self._figures, self._written = self._server.gui.add_html("waiting for the first frames"), 0.0
            stack.pop_all()  # it is open

    @property
    def address(self) -> str:
        """Of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def publish(self, moment: Moment) -> None:
        """Show a moment; see `Publisher`."""
        figures_s = 0.1  # between two sets of figures, and pictures under them: faster ones can't be read
        with self._server.atomic():
            _show(self._probe, moment.world_from_target)
            for name, handle in self._tools.items():
                _show(handle, tool_figures.body_of(moment, name).world_from_body)
            self._show_scan(moment.scan, moment.distances)
            self._show_unseen(moment.seen)
            if monotonic() - self._written > figures_s:  # figures and picture of one moment
                self._written = monotonic()
                picture = None if self._picture is None else with_tools(self._picture, moment.bodies)
                tools = tool_figures.html_of(moment, self._scene, self._alarms)
                self._figures.content = moment_figures.html_of(moment, self._scene.masses, picture, tools)
        self._server.flush()

    def close(self) -> None:
        """End."""
        with redirect_stdout(StringIO()):
            self._server.stop()

    def _show_scan(self, scan: PlacedScan | None, distances: Sequence[MassDistance]) -> None:
        if scan is not self._shown:
            self._shown, self._picture = scan, None if scan is None else outlined(scan, distances)
            if scan is not None and self._picture is not None:
                self._place(scan, self._picture)
        if self._scan is not None:
            self._scan.visible = scan is not None

    def _show_unseen(self, seen: SeenSoFar | None) -> None:
        """Show places that are still to be scanned; they vanish as they are seen well enough."""
        if seen is self._seen:
            return
        self._seen = seen
        points = np.empty((0, 3), np.float32) if seen is None else seen.points
        colours = np.empty((0, 3), np.uint8) if seen is None else colours_of(seen)
        places, size = points * np.float32(M), POINT_MM * M
        self._unseen = self._server.scene.add_point_cloud("/unseen", places, colours, point_size=size, point_shape="circle")

    def _place(self, scan: PlacedScan, picture: Picture) -> None:
        """Show a B-scan where it was taken, to the borders of its outer pixels."""
        (height, width), (across, down) = scan.image.shape, np.linalg.norm(scan.world_from_pixel[:3, :2], axis=0) * M
        quality = 85  # of JPEG
        if self._scan is None or self._scan.image.shape != picture.shape:
            self._scan = self._server.scene.add_image(
                "/scan", picture, width * across, height * down, jpeg_quality=quality, cast_shadow=False, receive_shadow=False
            )
        else:
            self._scan.image = picture
        self._scan.wxyz, self._scan.position = turn_of(scan.world_from_pixel), scan.corners.mean(axis=0) * M


def colours_of(seen: SeenSoFar) -> NDArray[np.uint8]:
    """Colours : (n, 3) of places that are still to be scanned, paler where it was seen half as well as it should be."""
    return np.where((seen.seen < HALF_WELL)[:, None], UNSEEN, HALF_SEEN).astype(np.uint8)


def outlined(scan: PlacedScan, distances: Sequence[MassDistance]) -> Picture:
    """A B-scan : (h, w, 3) with the outlines of masses that it cuts, and their names."""
    picture = cv2.cvtColor(scan.image, cv2.COLOR_GRAY2RGB)
    pixel_from_world = np.linalg.inv(scan.world_from_pixel)
    outline = (255, 210, 60)  # of masses that a B-scan cuts, drawn into it
    for each in distances:
        if each.in_image:
            pieces = np.rint(rigid.apply(pixel_from_world, each.outline)[..., :2]).astype(np.int32)
            cv2.polylines(picture, list(pieces), False, outline, 1, cv2.LINE_AA)
            at = name_place(each.name, pieces.reshape(-1, 2), scan.image.shape)
            for colour, thickness in ((IN_SPACE.ink[:3], 3), (outline, 1)):
                cv2.putText(picture, each.name, at, *FONT, colour, thickness, cv2.LINE_AA)
    return picture


def with_tools(picture: Picture, bodies: Sequence[BodyAt]) -> Picture:
    """A copy of a B-scan : (h, w, 3) with the part of each tool's shaft that lies in its slice, and where the shaft crosses it.

    A cross stands for a shaft that will cross ahead of its tip, a ring for one that has crossed.
    """
    drawn = picture.copy()
    for body in bodies:
        plane = None if body.figures is None else body.figures.plane
        if plane is None:
            continue
        for colour, thickness in ((IN_SPACE.ink[:3], 3), (TOOL, 1)):
            if plane.seen is not None:
                first, last = (tuple(map(int, end)) for end in np.rint(np.clip(plane.seen, -FAR_PX, FAR_PX)))
                cv2.line(drawn, first, last, colour, thickness, cv2.LINE_AA)
            if plane.crossing is not None and plane.crossing.in_image:
                u, v = np.rint(plane.crossing.pixel).astype(int).tolist()
                if plane.crossing.ahead_mm >= 0:
                    cv2.drawMarker(drawn, (u, v), colour, cv2.MARKER_TILTED_CROSS, 2 * MARK_PX, thickness, cv2.LINE_AA)
                else:
                    cv2.circle(drawn, (u, v), MARK_PX, colour, thickness, cv2.LINE_AA)
                cv2.putText(drawn, body.name, (u + 2 * MARK_PX, v + MARK_PX), *FONT, colour, thickness, cv2.LINE_AA)
    return drawn


def name_place(name: str, outline: NDArray[np.int32], shape: tuple[int, ...]) -> tuple[int, int]:
    """Lower left corner of a name in a picture of a shape (h, w): over the outline : (n, 2) px, else under it, else within."""
    (width, height), below = cv2.getTextSize(name, *FONT, 1)
    corner = np.array(shape[1::-1]) - 1
    (left, top), (right, bottom) = (np.clip(each, 0, corner) for each in (outline.min(axis=0), outline.max(axis=0)))
    over, under = int(top) - NAME_GAP_PX - below, int(bottom) + NAME_GAP_PX + height
    row = over if over >= height else under if under + below <= shape[0] else int(top + bottom + height) // 2
    return max(0, min(int(left + right - width) // 2, shape[1] - width)), row


def turn_of(to_from: Array) -> Array:
    """Quaternion : (4,) wxyz of the directions of a matrix : (4, 4), whose first two columns may have any length."""
    x, y = (to_from[:3, axis] / np.linalg.norm(to_from[:3, axis]) for axis in (0, 1))
    return np.roll(Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)])).as_quat(), 1)


def _add_scene(server, scene: StillScene):
    """Add what stands still; returns the handle of the probe, which moves."""
    outside, inside = 0.5, 0.1  # opacity of the skin's two sides: where both were alike, a dome would look like a bowl
    if scene.skin is not None:
        _add_mesh(server, "/skin", scene.skin, IN_SPACE.skin[:3], "front", outside)
        _add_mesh(server, "/skin/inside", scene.skin, IN_SPACE.skin[:3], "back", inside)
    for name, mesh in scene.masses.items():
        _add_mesh(server, f"/masses/{name}", mesh, IN_SPACE.mass[:3])
        top = np.array([mesh.bounds[:, 0].mean(), mesh.bounds[0, 1], mesh.bounds[:, 2].mean()])  # y of the world is down
        server.scene.add_label(f"/names/{name}", name, position=top * M, anchor="bottom-center", font_screen_scale=0.8)
    if scene.plan is not None:
        entry, aim = scene.plan
        _add_mesh(server, "/plan/path", trimesh.creation.cylinder(PLAN_MM, segment=scene.plan, sections=12), PLAN)
        _add_mesh(server, "/plan/aim", trimesh.creation.icosphere(2, AIM_MM).apply_translation(aim), PLAN)
        server.scene.add_label("/plan/entry", "entry", position=entry * M, anchor="bottom-center", font_screen_scale=0.8)
    handle = server.scene.add_frame("/probe", show_axes=False, visible=False)
    for name, mesh, colour in (("body", scene.probe, IN_SPACE.body[:3]), ("circles", scene.circles, IN_SPACE.ink[:3])):
        if mesh is not None:
            _add_mesh(server, f"/probe/{name}", mesh, colour)
    server.scene.set_up_direction((0.0, -1.0, 0.0))
    server.scene.configure_default_lights(False)
    server.scene.configure_environment_map(None)
    # light from the viewer's side, low, so that what is bent shows as bent
    ambient, sun, sun_stands = 0.5, 4.0, (-1.0, -1.2, -0.5)
    server.scene.add_light_ambient("/light", intensity=ambient)
    server.scene.add_light_directional("/sun", intensity=sun, position=sun_stands)
    middle, radius = _looked_at(scene)
    server.initial_camera.position = (middle + DISTANCE * radius * ASIDE) * M
    server.initial_camera.look_at = middle * M
    server.initial_camera.up = (0.0, -1.0, 0.0)
    server.initial_camera.fov = FIELD_RAD
    return handle


def _add_tool(server, name: str, mesh: trimesh.Trimesh):
    """Add a tool; returns its handle."""
    handle = server.scene.add_frame(f"/tools/{name}", show_axes=False, visible=False)
    _add_mesh(server, f"/tools/{name}/shape", mesh, TOOL)
    server.scene.add_label(f"/tools/{name}/name", name, anchor="bottom-center", font_screen_scale=0.8)
    return handle


def _show(handle, world_from_body: Array | None) -> None:
    """Show a body where it is, or hide it."""
    handle.visible = world_from_body is not None
    if world_from_body is not None:
        handle.wxyz, handle.position = turn_of(world_from_body), world_from_body[:3, 3] * M


def _add_mesh(
    server, name: str, mesh: trimesh.Trimesh, colour: tuple[int, int, int], side: str = "double", opacity: float | None = None
) -> None:
    vertices = np.asarray(mesh.vertices) * M
    server.scene.add_mesh_simple(
        name, vertices, np.asarray(mesh.faces), color=colour, opacity=opacity, side=side, cast_shadow=False
    )


def _looked_at(scene: StillScene) -> tuple[Array, float]:
    """Middle : (3,) mm of what stands still, and half its diagonal."""
    known = [np.asarray(mesh.bounds, float) for mesh in (scene.skin, *scene.masses.values()) if mesh is not None]
    low, high = known[0] if known else SPACE_MM
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def _free_port(host: str, port: int) -> int:
    """The port, or any for 0. Refuses one that another program has: the server would silently take the next."""
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, port))
            return trial.getsockname()[1]
        except OSError as error:
            found = f"found it refused: {error.strerror}; give another view.port, or close the other program"
            raise InputError(f"view: expected to listen on {host}:{port}, {found}") from None
