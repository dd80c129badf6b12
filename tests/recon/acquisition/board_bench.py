"""A small rig before a calibration board: rays meet its plane, and the projector's pattern lies where they do."""

from functools import partial

import cv2
import numpy as np

from recon.devices.pattern_player import Stage, Triggered
from recon.model.rig import Rig
from tests.recon import board_views
from tests.recon.acquisition.stand_ins import Bench, BenchCamera
from tests.recon.board_sets import BOARD, DEVICES, devices

SMALL = 0.4  # of the images' sides: enough for the detector


def small(rig: Rig) -> Rig:
    """The rig with fewer and larger pixels, and lenses without distortion, for speed."""
    return rig.model_copy(update={name: _small(getattr(rig, name)) for name in DEVICES})


def _small(device):
    optics = device.optics
    pixels = {name: tuple(SMALL * value for value in getattr(optics, name)) for name in ("focal_px", "centre_px")}
    size = tuple(int(SMALL * side) for side in optics.size)
    return device.model_copy(update={"optics": optics.model_copy(update={**pixels, "size": size, "distortion": ()})})


def stage(rig: Rig, names=("cam1", "cam2")) -> tuple[Bench, Stage]:
    """A bench, and its devices; nothing is held yet."""
    bench = Bench()
    bench.size, bench.looking = rig.projector.optics.size, names
    cameras = {name: BenchCamera(name, bench) for name in names}
    for name, camera in cameras.items():
        camera.size = getattr(rig, name).optics.size
    return bench, Stage(bench, cameras, Triggered(timeout_s=0.01))


def hold(bench: Bench, rig: Rig, pose: np.ndarray) -> None:
    """Hold the board in a pose `world_from_board` : (4, 4) mm."""
    views = {name: view(rig, name, pose) for name in bench.looking}
    bench.seen = lambda camera: _seen(bench, *views[camera])


def _seen(bench: Bench, white: np.ndarray, at: np.ndarray) -> np.ndarray:
    return white * (0.02 + cv2.remap(np.float32(bench.pattern), *at, cv2.INTER_LINEAR) / 255)


def view(rig: Rig, name: str, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance : (h, w) of the board as a camera sees it, and the projector's pixels : (2, h, w) that light it."""
    camera, projector = devices(rig)[name], devices(rig)["projector"]
    rays, normal = camera.rays(camera.pixel_grid().reshape(-1, 2)), pose[:3, 2]
    world = camera.centre + rays * (((pose[:3, 3] - camera.centre) @ normal) / (rays @ normal))[:, None]
    xy = ((world - pose[:3, 3]) @ pose[:3, :2]).reshape(*camera.size[::-1], 2)
    white = board_views.shares(BOARD, xy, footprint=pose[2, 3] / camera.matrix[0, 0])
    blurred = cv2.GaussianBlur(0.1 + 0.8 * white, (0, 0), 0.7)
    return blurred, np.float32(projector.project(world).T.reshape(2, *camera.size[::-1]))


class Hand:
    """Holds the board as it is asked to, or as the test has it, and gives the test's answers, then ends."""

    def __init__(self, bench: Bench, rig: Rig, answers, places=()) -> None:
        self.asked, self._hold = [], partial(hold, bench, rig)
        self._answers, self._places = list(answers), list(places)

    def ask(self, step) -> None:
        self.asked.append(step)
        place = self._places.pop(0) if self._places else None
        if callable(place):
            place()
        else:
            self._hold(step.world_from_board if place is None else place)

    def answer(self):
        return self._answers.pop(0) if self._answers else "end"
