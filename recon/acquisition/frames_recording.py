"""Guided recording of frames that show the sensors: of covered lenses, of an even light, of the scene without the projector."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.acquisition.exposure_setting import Exposing, set_exposure
from recon.acquisition.frame_checks import BRIGHTEST, Images
from recon.acquisition.guidance import PENDING, Operator, Step, sentence
from recon.acquisition.pictures import Picture, Say, Show
from recon.acquisition.recording import Recording
from recon.capture.manifest import Device
from recon.devices.pattern_player import Stage, take

Kind = Literal["dark", "flat", "room"]
FRAMES = 16  # of each camera and level
WORDS: dict[Kind, str] = {
    "dark": "cover both lenses, best by their caps and a black cloth over them",
    "flat": "hold white paper square before each lens, a hand's breadth away, so that the projector lights it evenly",
    "room": "leave all as the surface was recorded, and hold a black card before the projector's lens",
}


@dataclass(frozen=True)
class FrameLimits:
    """Limits beyond which such frames have a fault; DN of 255."""

    dark_dn: float = 12.0  # mean of a dark frame: cameras' black levels are some DN
    leak_dn: float = 3.0  # between the darkest and the brightest part of it
    even: float = 0.4  # darkest part over the brightest of an even light: two stops of vignetting
    full: float = 0.8  # of full scale, to which an even light is exposed
    least: float = 0.5  # of full scale, that it must reach
    saturated: float = 1e-3  # share of its pixels at full scale
    room: float = 0.5  # of full scale, of the scene without the projector


@dataclass(frozen=True)
class FramesPlan:
    """What is to be recorded."""

    kind: Kind
    devices: Mapping[str, Device]  # cameras as the fringes were taken; of an even light the exposure is set for it
    limits: FrameLimits = FrameLimits()

    def set_cameras(self, stage: Stage, seconds: Mapping[str, float] | None = None) -> None:
        """Set exposures, those of the fringes if no others are given, and gains."""
        for name, camera in stage.cameras.items():
            own = self.devices[name].exposure_s if seconds is None else seconds[name]
            assert own is not None
            camera.set_exposure(own, self.gain(name))

    def gain(self, camera: str) -> float:
        """A camera's gain."""
        return self.devices[camera].gain or 1.0


class _Light(NamedTuple):
    """What a stack of frames shows, DN of 255."""

    mean: float
    low: float  # of parts of the image
    high: float
    level: float  # of full scale, of the brightest thousandth of the pixels
    saturated: float


def record_frames(recording: Recording, stage: Stage, operator: Operator, plan: FramesPlan, say: Say, show: Show) -> bool:
    """Record when the operator is ready, in place of earlier ones; returns whether they were kept.

    Frames with faults are kept only if the operator then keeps them; whoever ends has none, as identification reads all.
    """
    operator.ask(Step(WORDS[plan.kind]))
    taken: dict[str, Images] = {}
    while True:
        _look(stage, plan, show)
        answer = operator.answer()
        if answer in PENDING:
            continue
        if answer == "end":
            return False
        if answer == "keep" and taken:
            break
        taken, faults = _flat(stage, plan, show) if plan.kind == "flat" else _still(stage, plan, show)
        for place, images in taken.items():
            say(f"{place} {images.mean():.1f} DN in the mean of {len(images)} images")
        if not faults or answer == "keep":
            break
        operator.ask(Step(f"{sentence(faults)}; take it again, or k keeps it as it is"))
    recording.add_frames(plan.kind, taken)
    return True


def _look(stage: Stage, plan: FramesPlan, show: Show) -> None:
    """Show what each camera sees."""
    plan.set_cameras(stage)
    for name, frame in take(stage, _shown(stage, plan)).items():
        show(Picture(name, frame.image, stage.cameras[name].bits, f"mean {frame.image.mean():.1f} DN"))


def _shown(stage: Stage, plan: FramesPlan) -> NDArray[np.uint8]:
    return stage.white if plan.kind == "flat" else stage.black


def _still(stage: Stage, plan: FramesPlan, show: Show) -> tuple[dict[str, Images], list[str]]:
    """Frames exposed as the fringes, by camera, and their faults."""
    plan.set_cameras(stage)
    taken, limits, faults = _taken(stage, plan, show), plan.limits, list[str]()
    for name, images in taken.items():
        light = _light(images, stage.cameras[name].bits)
        if plan.kind == "room" and light.level > limits.room:
            faults.append(f"{name} bright: {100 * light.level:.0f} % of full scale; is the projector covered?")
        if plan.kind == "dark" and light.mean > limits.dark_dn:
            faults.append(f"{name} isn't dark: {light.mean:.0f} DN of 255 in the mean; cover its lens")
        elif plan.kind == "dark" and light.high - light.low > limits.leak_dn:
            faults.append(f"{name} sees light: {light.high - light.low:.0f} DN of 255 from part to part; a cloth over its cap")
    return taken, faults


def _flat(stage: Stage, plan: FramesPlan, show: Show) -> tuple[dict[str, Images], list[str]]:
    """Frames of an even light in full and at half the exposure, by camera and level, and their faults."""
    limits, full = plan.limits, dict[str, float]()
    for name, camera in stage.cameras.items():
        alone, exposing = stage.of([name]), Exposing(level=limits.full, gain=plan.gain(name))
        full[name] = set_exposure(camera, lambda name=name, alone=alone: take(alone, alone.white)[name].image, exposing)
    taken, faults = dict[str, Images](), list[str]()
    for level, share in (("full", 1.0), ("half", 0.5)):
        plan.set_cameras(stage, {name: share * seconds for name, seconds in full.items()})
        taken |= {f"{name}/{level}": images for name, images in _taken(stage, plan, show).items()}
    for name in stage.cameras:
        light = _light(taken[f"{name}/full"], stage.cameras[name].bits)
        if light.saturated > limits.saturated:
            faults.append(f"{name} saturated: {100 * light.saturated:.1f} % of the pixels; turn the paper, or take matt one")
        if light.level < limits.least:
            faults.append(f"{name} dark: {100 * light.level:.0f} % of full scale at {1e3 * full[name]:.0f} ms; bring more light")
        elif light.low < limits.even * light.high:
            faults.append(f"{name} uneven: {light.low:.0f} to {light.high:.0f} DN of 255; hold the paper square to the lens")
    return taken, faults


def _taken(stage: Stage, plan: FramesPlan, show: Show) -> dict[str, Images]:
    """Frames : camera -> (FRAMES, h, w)."""
    shots = [take(stage, _shown(stage, plan)) for _ in range(FRAMES)]
    for name, frame in shots[-1].items():
        show(Picture(name, frame.image, stage.cameras[name].bits, f"the last of {FRAMES}"))
    return {name: np.stack([shot[name].image for shot in shots]) for name in stage.cameras}


def _light(images: Images, bits: int) -> _Light:
    """Measure frames : (n, h, w)."""
    full, part_px = 2**bits - 1, 32  # of an image's parts, whose means noise doesn't reach
    mean = np.float32(images.mean(axis=0)) * np.float32(255 / full)
    size = (max(mean.shape[1] // part_px, 1), max(mean.shape[0] // part_px, 1))
    parts = cv2.resize(mean, size, interpolation=cv2.INTER_AREA)
    level = float(np.percentile(images[0, ::4, ::4], BRIGHTEST)) / full
    return _Light(float(mean.mean()), float(parts.min()), float(parts.max()), level, float((images >= full).mean()))
