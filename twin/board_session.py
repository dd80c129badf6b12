"""A calibration session in the twin: the board in random poses, lit and under fringes, pose by pose.

A pose that is done lies in `OUT/unfinished/`. A run that was stopped goes on from there if its settings are the same; the
finished set then takes its place as `OUT/capture/` and `OUT/truth/`.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.capture import calibration_files, writer
from recon.capture.manifest import MANIFEST, OPTICS, BoardPart, Device, read_manifest
from recon.errors import InputError
from recon.files import atomic, written_files
from recon.geometry import rigid
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from scenes import board_poses
from scenes.kinds import board
from scenes.scene_types import Scene, Thing
from twin.conditions import IDEAL, Conditions, draw, flexed, printed_board
from twin.optics.disturbed_light import emitted, with_stray
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Images, Tracing, meets_something, render_pixels
from twin.optics.printed_edges import compute_edges
from twin.optics.projected_image import ImageLight
from twin.optics.raster import Light
from twin.optics.ray_world import build_world, is_convex, move_things
from twin.optics.surface_session import CameraName, Shooting, calibration_of, camera_optics, describe_visible, device_of
from twin.sensor import Exposure, Numbers, auto_exposure, expose
from twin.session import CAPTURE, SETTINGS, TWIN, Session, read_json, write_json

FRINGE_CAMERA: CameraName = "cam1"  # sees the fringes; others see the board lit only
CAMERAS: tuple[CameraName, CameraName] = ("cam1", "cam2")
UNFINISHED = "unfinished"

EVEN_SAMPLES = 8  # paths for a pixel of an image without fringes, where all that it sees has one brightness
EDGE_SAMPLES = 256  # paths for a pixel at the edge of a circle that isn't computed, which is half black, half white
SIDE_SAMPLES = 64  # paths for a pixel at a side of the board


@dataclass(frozen=True)
class Stage:
    """The constants of all poses: the instruments, and the board in its own frame."""

    rig: Rig
    cameras: dict[CameraName, CameraOptics]
    projector: ProjectorOptics
    patterns: Light
    things: tuple[Thing, ...]  # in the board's frame
    print: board.Print  # the same by formulas
    world: mi.Scene  # the same things; moved from pose to pose
    convex: bool  # whether they are one convex body, as a flat board is


@dataclass(frozen=True)
class Settings:
    """Everything that a session is rendered from."""

    rig: Rig
    board: board.Config
    poses: board_poses.Config
    patterns: Patterns
    cameras: tuple[CameraName, ...]
    tracing: Tracing
    shooting: Shooting
    seed: int
    conditions: Conditions = IDEAL

    @property
    def printed(self) -> board.Config:
        """The board as printed, which its design is not."""
        return printed_board(self.board, self.conditions.board, self.seed)

    def bent(self, number: int) -> board.Config:
        """The board as it is bent in a pose."""
        return flexed(self.printed, self.conditions.board, self.seed, number)


def set_up(settings: Settings) -> Stage:
    """Build the stage of a session."""
    things = board.things(settings.printed)
    return Stage(
        settings.rig,
        {camera: camera_optics(settings.rig, camera) for camera in settings.cameras},
        ProjectorOptics.of(settings.rig.projector),
        Light.of(settings.patterns, settings.rig.projector),
        things,
        board.printed(settings.printed),
        build_world(Scene("board", things)),
        is_convex(things),
    )


def with_board(stage: Stage, bent: board.Config) -> Stage:
    """The stage with another board."""
    things = board.things(bent)
    world = build_world(Scene("board", things))
    return replace(stage, things=things, print=board.printed(bent), world=world, convex=is_convex(things))


def place_all(settings: Settings) -> rigid.Array:
    """Poses `world_from_board` : (p, 4, 4) of a session; every device sees the whole board, whichever takes part."""
    devices = list(calibration_of(settings.rig).cameras.values())
    return board_poses.random_poses(settings.poses, board.design(settings.board), devices)


def set_exposures(stage: Stage, settings: Settings) -> dict[CameraName, Exposure]:
    """One exposure a camera for all poses, as one would set it: for the board held up close, turned to the projector.

    Turned that way white is at its brightest, and a glossy coat throws its highlight back into the projector.
    """
    shooting, wavelength = settings.shooting, settings.rig.projector.wavelength_nm
    exposures = {}
    for camera, optics in stage.cameras.items():
        device = getattr(settings.rig, camera)
        time_s = shooting.exposure_s
        if time_s is None:
            move_things(stage.world, stage.things, closest_pose(settings))
            radiance = trace_near(stage, optics, fully_on(stage.patterns), settings.tracing, 0)
            time_s = auto_exposure(radiance, device, wavelength, level=shooting.level / shooting.gain)
        exposures[camera] = Exposure(time_s, shooting.gain, shooting.bits)
    return exposures


def closest_pose(settings: Settings) -> rigid.Array:
    """The board at its nearest, in the middle of camera 1's view, turned to the projector : (4, 4)."""
    optics = calibration_of(settings.rig).cameras
    view = optics["cam1"]
    axis = view.rays((np.array(view.size) - 1.0) / 2)
    middle = axis * settings.poses.depths_mm[0] / axis[2]
    away = middle - optics["projector"].centre
    away /= np.linalg.norm(away)
    across = np.cross([0.0, 1.0, 0.0], away)
    across /= np.linalg.norm(across)
    rotation = np.column_stack([across, np.cross(away, across), away])
    points = board.design(settings.board).points()
    return rigid.transform(rotation, middle - rotation @ points.mean(axis=0))


def shoot_pose(
    stage: Stage, settings: Settings, exposures: Mapping[CameraName, Exposure], number: int, world_from_board: rigid.Array
) -> tuple[dict[str, Numbers], dict[str, Numbers]]:
    """Take the images of one pose: of each camera the lit board (h, w), of camera 1 the fringes (n, h, w).

    They depend on the seed and the pose's number alone, whichever poses were rendered before. Of the frames' errors the lit
    image, which is one by itself, has none.
    """
    if settings.conditions.board.flex_mm:
        stage = with_board(stage, settings.bent(number))
    move_things(stage.world, stage.things, world_from_board)
    frames = draw(settings.conditions.frames, settings.patterns.count, settings.seed, number)
    shown = emitted(settings.patterns, settings.rig.projector, frames)
    lit, fringes = {}, {}
    for camera, optics in stage.cameras.items():
        key = [settings.seed, number, CAMERAS.index(camera)]
        light_seed, edge_seed, sensor_seed = np.random.SeedSequence(key).generate_state(3).tolist()
        light, tracing, stray_dn = with_fully_on(shown), settings.tracing, np.append(frames.stray_dn, 0.0)
        if camera != FRINGE_CAMERA:
            light, tracing = fully_on(stage.patterns), tracing.model_copy(update={"samples": EVEN_SAMPLES})
            stray_dn = stray_dn[-1:]
        radiance = trace_near(stage, optics, light, tracing, light_seed)
        on = radiance[-1]
        refine_edges(on, stage, optics, settings.tracing, world_from_board, edge_seed)
        radiance.near[-1] = on.ravel()[radiance.pixels]
        device, wavelength = getattr(settings.rig, camera), settings.rig.projector.wavelength_nm
        seen = with_stray(radiance, stray_dn, device, wavelength, exposures[camera])
        images = expose(seen, device, wavelength, exposures[camera], sensor_seed)
        lit[camera] = images[-1]
        if camera == FRINGE_CAMERA:
            fringes[camera] = images[:-1]
    return lit, fringes


@dataclass(frozen=True)
class NearBoard:
    """Images : n of (h, w), W/mm^2/sr, that differ in some pixels only; the rest shows the room."""

    room: Images  # (h, w)
    pixels: NDArray[np.uint32]  # (m,) numbers `v * width + u`
    near: Images  # (n, m)

    def __getitem__(self, k: int) -> Images:
        image = self.room.copy()
        image.ravel()[self.pixels] = self.near[k]
        return image

    def __iter__(self) -> Iterator[Images]:
        return (self[k] for k in range(len(self.near)))

    @property
    def shape(self) -> tuple[int, ...]:
        """Of all images together : (n, h, w)."""
        return len(self.near), *self.room.shape


def trace_near(stage: Stage, optics: CameraOptics, light: Light | ImageLight, tracing: Tracing, seed: int) -> NearBoard:
    """As `light_transport.render`, but only the board and what is near are traced; the rest of an image shows the room."""
    box = stage.world.bbox()
    corners = np.array([box.corner(k) for k in range(8)]).reshape(8, 3)
    depths = rigid.apply(optics.camera.camera_from_world, corners)[:, 2]
    reach = math.ceil(optics.reach_px(np.maximum(depths, 1.0)))
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    seen = cv2.dilate(np.uint8(meets_something(stage.world, optics)), window)
    pixels = np.flatnonzero(seen).astype(np.uint32)
    near = np.empty((light.count, 0), np.float32)
    if len(pixels):
        near = render_pixels(stage.world, optics, stage.projector, light, tracing, seed, pixels, convex=stage.convex)
    return NearBoard(optics.transmission * np.float32(tracing.room_radiance), pixels, near)


def refine_edges(
    radiance: Images, stage: Stage, optics: CameraOptics, tracing: Tracing, world_from_board: rigid.Array, seed: int
) -> None:
    """Compute the pixels at edges of discs in a lit image : (h, w), in place; trace the rest of them, and the sides, anew."""
    left = compute_edges(radiance, optics, stage.print, world_from_board, seed)
    for pixels, samples in ((left.edges, EDGE_SAMPLES), (left.sides, SIDE_SAMPLES)):
        if len(pixels):
            finer = tracing.model_copy(update={"samples": max(tracing.samples, samples)})
            light = fully_on(stage.patterns)
            found = render_pixels(stage.world, optics, stage.projector, light, finer, seed, pixels, convex=stage.convex)
            radiance.ravel()[pixels] = found[0]


def fully_on(light: Light) -> Light:
    """The projector with all pixels on."""
    return replace(light, axes=("columns",), profiles=(np.ones(light.size[0], np.float32),))


def with_fully_on(light: Light) -> Light:
    """A sequence, and then all pixels on."""
    on = fully_on(light)
    return replace(light, axes=light.axes + on.axes, profiles=light.profiles + on.profiles)


def pose_name(number: int) -> str:
    """Name of a pose, by which its folder is called."""
    return f"{number:02d}"


def is_finished(session: Session) -> bool:
    """Whether the board of this session is there already, whole; other parts beside it don't count."""
    kept = session.truth.described / SETTINGS
    if not (kept.is_file() and (session.capture / MANIFEST).is_file() and session.truth.settings() == session.settings):
        return False
    return read_manifest(session.capture).board is not None


def check_place(folder: Path) -> None:
    """Check, before any work, that a folder is new or one in which a board's images are kept; else raises InputError."""
    if not any((folder / file).is_file() for file in (f"{UNFINISHED}/{SETTINGS}", f"{CAPTURE}/{MANIFEST}")):
        atomic.check_folder(folder, TWIN)


def missing_poses(session: Session, settings: Settings) -> list[int]:
    """Numbers of the poses that are still to be rendered; what is left of a run with other settings is removed.

    Raises
    ------
    InputError
        As of `Session.check`; or if what an unfinished run has left is damaged.
    """
    session.check()
    unfinished = session.out / UNFINISHED
    atomic.check_folder(unfinished, TWIN)
    kept = unfinished / SETTINGS
    if not kept.is_file() or read_json(kept) != session.settings:
        written_files.discard(unfinished, TWIN, writer.POSE)
        with atomic.new_folder(unfinished, TWIN) as folder:
            write_json(folder / SETTINGS, session.settings)
    places = [unfinished / "capture" / "board" / pose_name(k) for k in range(settings.poses.count)]
    return [k for k, place in enumerate(places) if not written_files.is_whole(place)]


def write_pose(session: Session, number: int, lit: Mapping[str, Numbers], fringes: Mapping[str, Numbers]) -> None:
    """Keep one pose's images, whole or not at all."""
    writer.write_pose(session.out / UNFINISHED / "capture", pose_name(number), lit, fringes)


def finish(session: Session, settings: Settings, exposures: Mapping[CameraName, Exposure], placed: rigid.Array) -> None:
    """Write the board, from the poses that are kept, and its truth."""
    names = [pose_name(k) for k in range(len(placed))]
    counts: dict[str, int] = {FRINGE_CAMERA: settings.patterns.count}
    records = tuple(writer.describe_pose(name, settings.cameras, counts) for name in names)
    part = BoardPart(board=board.design(settings.board), patterns=settings.patterns, poses=records)
    devices = {"projector": Device(size=settings.patterns.projector_size)}
    for camera, exposure in exposures.items():
        devices[camera] = device_of(getattr(settings.rig, camera).optics.size, exposure)
    with session.write(describe_visible(Scene("board", board.things(settings.printed)))) as (capture, truth):
        truth.write_optics(calibration_of(settings.rig))
        truth.write_arrays("board.npz", board_truth(settings, placed))
        atomic.link_tree(session.out / UNFINISHED / "capture", capture.folder, leave_out={MANIFEST})
        capture.add_board(part, devices)
    written_files.discard(session.out / UNFINISHED, TWIN, writer.POSE)


def take_over(kept: Session, session: Session) -> None:
    """Let a session have the board of another, as links to its files, unless it has it already; raises as `Session.check`."""
    if is_finished(session):
        return
    session.check()
    with atomic.alone(kept.out / "board"), session.write(kept.truth.scene()) as (capture, truth):
        read = read_manifest(kept.capture)
        if read.board is None or not is_finished(kept):
            raise InputError(f"{kept.out}: expected the board's images as they were rendered, found others: of another run?")
        truth.write_optics(calibration_files.read(kept.truth.folder / OPTICS))
        atomic.link_file(kept.truth.folder / "board.npz", truth.folder / "board.npz")
        atomic.link_tree(kept.capture / "board", capture.folder / "board")
        capture.add_board(read.board, read.devices_of("board"))


def board_truth(settings: Settings, placed: rigid.Array) -> dict[str, np.ndarray]:
    """Ground truth, for evaluation alone: poses (p, 4, 4), printed centres (n, 3) mm, and where the three devices see these.

    Pixels : (p, n, 3, 2) are those of the centres in cam1, cam2 and the projector, not of the middles of the ellipses; of a board
    that flexes those of its shape in each pose, while the printed centres are those of its mean shape.
    """
    points = np.stack([rigid.apply(pose, board.printed_centres(settings.bent(k))) for k, pose in enumerate(placed)])
    cameras = calibration_of(settings.rig).cameras
    pixels = np.stack([cameras[name].project(points) for name in ("cam1", "cam2", "projector")], axis=2)
    return {"world_from_board": placed, "points": board.printed_centres(settings.printed), "pixels": pixels}
