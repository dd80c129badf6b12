"""What recordings of things at rest share: looks at what is lit, sequences, exposures, and the cameras as they are set."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.acquisition import frame_checks
from recon.acquisition.exposure_setting import Exposing, set_exposure
from recon.acquisition.frame_checks import Limits, Look
from recon.acquisition.pictures import Over, Picture, Say, Show, bare
from recon.capture.manifest import Device
from recon.devices.interfaces import Camera, Frame, Size
from recon.devices.pattern_player import Pattern, Stage, play, take


@dataclass
class StillSession:
    """Cameras and projector before something at rest. Its state is the exposures."""

    stage: Stage
    exposing: Exposing
    limits: Limits
    say: Say
    show: Show
    judged: Callable[[Look, Limits], list[str]] = frame_checks.frame_faults  # faults of a frame
    over: Callable[[str, NDArray], Over | None] = bare  # of a camera's image under even light
    _exposures: dict[str, float] = field(default_factory=dict)  # s, by camera

    def look(self) -> dict[str, NDArray]:
        """Take an image of each camera under even light, and show it : camera -> (h, w)."""
        if not self._exposures:
            return self.expose()
        return self._lit()

    def expose(self) -> dict[str, NDArray]:
        """Set exposures for what is seen, and look."""
        for name, camera in self.stage.cameras.items():
            alone = self.stage.of([name])
            lit = lambda name=name, alone=alone: take(alone, alone.white)[name].image  # noqa: E731
            self._exposures[name] = set_exposure(camera, lit, self.exposing)
        times = ", ".join(f"{name} {1e3 * seconds:.3g} ms" for name, seconds in self._exposures.items())
        self.say(f"exposure {times}")
        return self._lit()

    def _lit(self) -> dict[str, NDArray]:
        frames = take(self.stage, self.stage.white)
        self.seen(frames)
        return {name: frame.image for name, frame in frames.items()}

    def faults(self, images: Mapping[str, NDArray]) -> list[str]:
        """Faults of images : camera -> (h, w), each with its camera and the way to mend it."""
        return [
            f"{name} {fault}"
            for name, image in images.items()
            for fault in self.judged(frame_checks.look(image, self.stage.cameras[name].bits), self.limits)
        ]

    def seen(self, frames: Mapping[str, Frame]) -> None:
        """Show frames as they come."""
        for name, frame in frames.items():
            bits = self.stage.cameras[name].bits
            found = frame_checks.look(frame.image, bits)
            faults = self.judged(found, self.limits)
            self.show(Picture(name, frame.image, bits, found.text, tuple(faults), self.over(name, frame.image)))

    def sequence(self, patterns: Iterable[Pattern], names: Sequence[str]) -> tuple[dict[str, NDArray], list[str]]:
        """Take a sequence with some of the cameras : camera -> (n, h, w), and name the faults of its light, a line each.

        Frames are shown as they come, without a look at each: the sequence is judged as a whole.
        """
        taken: dict[str, list[NDArray]] = {name: [] for name in names}
        faults: list[str] = []
        with closing(play(self.stage.of(names), patterns)) as shots:  # so that an interrupt stops the cameras
            for shot in shots:
                faults += [fault for fault in shot.faults if fault not in faults]
                for name, frame in shot.frames.items():
                    taken[name].append(frame.image)
                    self.show(Picture(name, frame.image, self.stage.cameras[name].bits, "under a pattern"))
        return {name: np.stack(images) for name, images in taken.items()}, faults

    def devices(self, projector: Size) -> dict[str, Device]:
        """Cameras and projector as a capture describes them."""
        cameras = {
            name: as_set({name: camera}, self._exposures[name], self.exposing.gain)[name]
            for name, camera in self.stage.cameras.items()
        }
        return cameras | {"projector": Device(size=projector)}


def as_set(cameras: Mapping[str, Camera], exposure_s: float, gain: float) -> dict[str, Device]:
    """Cameras as a capture describes them, with one exposure."""
    settings = {"exposure_s": exposure_s, "gain": gain}
    return {name: Device.model_validate({"size": one.size, "bits": one.bits, **settings}) for name, one in cameras.items()}
