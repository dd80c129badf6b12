"""What stands before the virtual rig at rest: a scene, or a calibration board that is held in one pose after the other.

A camera's images of a sequence that is known ahead are rendered in one pass when the first is asked for, and kept.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import DeviceError
from recon.geometry import rigid
from recon.model.rig import Rig
from scenes.kinds import board
from scenes.scene_types import Scene
from twin.board_session import CAMERAS, EVEN_SAMPLES, FRINGE_CAMERA, NearBoard, Stage, refine_edges, trace_near
from twin.devices.shown_light import KnownLight, Pattern
from twin.optics.instruments import ProjectorOptics
from twin.optics.light_transport import Images, Tracing, render
from twin.optics.projected_image import ImageLight
from twin.optics.raster import Light
from twin.optics.ray_world import build_world, is_convex, move_things, translucent
from twin.optics.surface_session import CameraName, camera_optics
from twin.sensor import electrons_per_radiance


@dataclass
class StillScene:
    """A scene at rest."""

    rig: Rig
    scene: Scene
    known: KnownLight
    tracing: Tracing
    seed: int = 0
    _images: dict[str, Images] = field(default_factory=dict, init=False)  # of the known sequence, by camera

    def __post_init__(self) -> None:
        self._world, self._projector = build_world(self.scene), ProjectorOptics.of(self.rig.projector)
        self._optics = {name: camera_optics(self.rig, name) for name in CAMERAS}

    def radiance(self, camera: CameraName, shown: Pattern) -> NDArray[np.float32]:
        """What arrives at a camera's pixels while a pattern is shown : (h, w), W/mm^2/sr."""
        light, place = self.known.find(shown)
        if light is not self.known.light:
            return self._rendered(camera, light)[place]
        if camera not in self._images:
            self._images[camera] = self._rendered(camera, light)
        return self._images[camera][place]

    def _rendered(self, camera: CameraName, light: Light | ImageLight) -> Images:
        seed = int(np.random.SeedSequence([self.seed, CAMERAS.index(camera)]).generate_state(2)[0])
        soft = translucent(self.scene, self._world) if isinstance(light, Light) else ()  # images don't spread beneath skin
        return render(self._world, self._optics[camera], self._projector, light, self.tracing, seed, soft)


@dataclass
class EvenLight:
    """Light that is nearly the same all over each camera's image, as of paper out of focus; none of covered lenses."""

    rig: Rig
    level: float  # of the charge that saturates a pixel, in 10 ms

    def radiance(self, camera: CameraName, shown: Pattern) -> NDArray[np.float32]:
        """What arrives at a camera's pixels : (h, w), W/mm^2/sr, a fifth less in one corner."""
        return even_radiance(self.rig, camera, self.level, 0.01)


def even_radiance(rig: Rig, camera: CameraName, level: float, seconds: float) -> NDArray[np.float32]:
    """Light : (h, w) W/mm^2/sr that falls by a fifth towards one corner; in so many seconds a share `level` saturates a pixel."""
    device = getattr(rig, camera)
    width, height = device.optics.size
    slope = np.linspace(1.0, 0.9, width) * np.linspace(1.0, 0.9, height)[:, None]
    electrons = electrons_per_radiance(device, rig.projector.wavelength_nm) * seconds
    return np.float32(slope * level * device.sensor.saturation_e / electrons)


@dataclass
class HeldBoard:
    """A calibration board, held as steadily as by a stand. `hold` puts it elsewhere."""

    rig: Rig
    design: board.Config
    known: Mapping[str, KnownLight]  # by camera; in each the last pattern is all white
    tracing: Tracing
    seed: int = 0
    _held: int = field(default=0, init=False)  # poses so far
    _images: dict[str, NearBoard] = field(default_factory=dict, init=False)  # of the known sequences in this pose, by camera

    def __post_init__(self) -> None:
        things = board.things(self.design)
        cameras = {name: camera_optics(self.rig, name) for name in CAMERAS}
        world, printed = build_world(Scene("board", things)), board.printed(self.design)
        projector, light = ProjectorOptics.of(self.rig.projector), self.known[FRINGE_CAMERA].light
        self._stage = Stage(self.rig, cameras, projector, light, things, printed, world, is_convex(things))
        self._pose: rigid.Array | None = None

    def hold(self, world_from_board: rigid.Array) -> None:
        """Hold the board in a pose : (4, 4) mm."""
        self._pose = world_from_board
        self._held += 1
        self._images.clear()
        move_things(self._stage.world, self._stage.things, world_from_board)

    def radiance(self, camera: CameraName, shown: Pattern) -> NDArray[np.float32]:
        """What arrives at a camera's pixels while a pattern is shown : (h, w), W/mm^2/sr; as `board_session.shoot_pose`."""
        if self._pose is None:
            raise DeviceError("board: expected one that is held before the cameras, found none")
        known = self.known[camera]
        light, place = known.find(shown)
        if light is not known.light:
            return self._traced(camera, light)[place]
        if camera not in self._images:
            images = self._traced(camera, light)
            on, edge_seed = images[-1], self._seeds(camera)[1]
            refine_edges(on, self._stage, self._stage.cameras[camera], self.tracing, self._pose, edge_seed)
            images.near[-1] = on.ravel()[images.pixels]
            self._images[camera] = images
        return self._images[camera][place]

    def _traced(self, camera: CameraName, light: Light | ImageLight) -> NearBoard:
        even = isinstance(light, Light) and all(np.ptp(profile) == 0 for profile in light.profiles)
        tracing = self.tracing.model_copy(update={"samples": EVEN_SAMPLES}) if even else self.tracing
        return trace_near(self._stage, self._stage.cameras[camera], light, tracing, self._seeds(camera)[0])

    def _seeds(self, camera: CameraName) -> list[int]:
        """Of light and edges."""
        return np.random.SeedSequence([self.seed, self._held, CAMERAS.index(camera)]).generate_state(2).tolist()


def white(rig: Rig) -> Pattern:
    """The pattern with all pixels on : (h, w)."""
    return np.full(rig.projector.optics.size[::-1], 255, np.uint8)


def known_to_scene(patterns: Sequence[Pattern], rig: Rig) -> KnownLight:
    """What cameras will see of a scene: black, a sequence, and white, as the player shows them."""
    even = white(rig)
    return KnownLight.of([np.zeros_like(even), *patterns, even], rig.projector)


def known_to_board(patterns: Sequence[Pattern], rig: Rig) -> dict[str, KnownLight]:
    """What each camera will see of a board: camera 1 the same as of a scene, camera 2 even light alone."""
    even = KnownLight.of([white(rig)], rig.projector)
    return {camera: known_to_scene(patterns, rig) if camera == FRINGE_CAMERA else even for camera in CAMERAS}
