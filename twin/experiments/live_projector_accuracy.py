"""Patterns on a display, and those that a camera did not see."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from recon.artwork import projected_images
from recon.devices import pattern_changes, projector_delay
from recon.devices.interfaces import Frame, Size, Trigger
from recon.devices.pattern_player import DOUBLED, Stage, Triggered, play
from recon.devices.projector_window import ProjectorWindow
from recon.model.patterns import Uniform
from scenes.catalogue import build_scene
from twin.experiments import virtual_screen
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting, shoot

TRACING, SHOOTING = Tracing(samples=16, room_lux=20), Shooting()
SEEDS = (1, 2)  # of two recordings


def display(setup: Setup) -> Figures:
    """All sequences on displays of their sizes, compared with screenshots; and taken through the player."""
    sequences = setup.sequences
    sizes = sorted({patterns.projector_size for patterns in sequences.values()})
    exact, taken, delays = [], [], []
    with virtual_screen.running(*(f"{width}x{height}x24" for width, height in sizes)) as desktop, _desktop(desktop):
        for patterns in sequences.values():
            index, images = sizes.index(patterns.projector_size), projected_images.images(patterns)
            camera = ScreenCamera(f"{desktop}.{index}", patterns.projector_size)
            projector = ProjectorWindow(patterns.projector_size, index, delay_s=0)
            try:
                for image in images:
                    projector.show(image)
                    exact.append(bool((virtual_screen.screenshot(camera.display) == image[..., None]).all()))
                delays.append(projector_delay.seconds_to_wait(projector, camera, flashes=4))
                shots = play(Stage(projector, {camera.name: camera}, Triggered()), images)
                taken += [
                    np.array_equal(shot.frames[camera.name].image, image) for shot, image in zip(shots, images, strict=True)
                ]
            finally:
                projector.close()
    shown = {"sequences": len(sequences), "patterns": len(exact), "exact": np.mean(exact), "taken": np.mean(taken)}
    return shown | {"delay_ms": 1e3 * max(delays)}


def doubled(setup: Setup) -> Figures:
    """The breast under all sequences of the rig's projector, twice; each pattern as shown, and as the one before."""
    size, scene = setup.rig.projector.optics.size, build_scene({"kind": "breast"})
    as_shown, as_before = [], []
    for patterns in setup.sequences.values():
        if patterns.projector_size != size:
            continue
        framed = patterns.model_copy(update={"parts": (Uniform(level=0), Uniform(level=1), *patterns.parts)})
        once, again = (shoot(setup.rig, scene, framed, "cam1", TRACING, SHOOTING, seed).images for seed in SEEDS)
        shown = projected_images.images(framed)
        light = pattern_changes.measure_light(once[0], once[1], again[1])
        for k in range(2, len(shown)):
            pair = (shown[k - 1], shown[k])
            as_shown.append(pattern_changes.change(light, (once[k - 1], again[k]), pair))
            as_before.append(pattern_changes.change(light, (once[k - 1], again[k - 1]), pair))
    found, false = (np.mean(np.array(changes) < DOUBLED) for changes in (as_before, as_shown))
    sizes = {"least": np.nanmin(as_shown), "largest_doubled": np.nanmax(as_before), "threshold": DOUBLED}
    return sizes | {"changes": len(as_shown), "found": found, "false": false}


class ScreenCamera:
    """A camera that sees a display pixel by pixel, by screenshots."""

    name, bits = "cam1", 8

    def __init__(self, display: str, size: Size) -> None:
        self.display, self.size = display, size

    def set_exposure(self, exposure_s: float, gain: float) -> None:
        """Nothing: a screenshot has none."""

    def start(self, trigger: Trigger) -> None:
        """Count from 0."""
        self._number = 0

    def trigger(self) -> None:
        """Take a screenshot."""
        self._image: NDArray[np.uint8] | None = virtual_screen.screenshot(self.display)[..., 1]

    def frame(self, timeout_s: float) -> Frame | None:
        """The screenshot."""
        image, self._image = self._image, None
        if image is None:
            return None
        self._number += 1
        now = time.monotonic_ns()
        return Frame(image, self._number - 1, now, now)

    def stop(self) -> None:
        """Nothing more to do."""

    def close(self) -> None:
        """Nothing to give back."""


@contextmanager
def _desktop(name: str) -> Iterator[None]:
    """Have windows open on a desktop."""
    before = os.environ.get("DISPLAY")
    os.environ["DISPLAY"] = name
    try:
        yield
    finally:
        if before is None:
            del os.environ["DISPLAY"]
        else:
            os.environ["DISPLAY"] = before
