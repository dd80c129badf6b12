"""Captures of films: a few drawn pairs of frames of a target that moves evenly."""

from pathlib import Path

import numpy as np

from recon.capture import stereo_frames
from recon.capture.manifest import Device
from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.calibration import Calibration
from tests.recon import captures
from tests.recon.tracking import drawings

PERIOD_NS = 33_333_333
START_NS = 10**18


def places(count: int, step_mm=(1.5, -0.5, 0.4)) -> np.ndarray:
    """Poses : (count, 4, 4) mm, evenly apart."""
    first = rigid.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 20.0, 660.0])
    moved = np.repeat(first[None], count, axis=0)
    moved[:, :3, 3] += np.arange(count)[:, None] * np.array(step_mm)
    return moved


def moved(place, turn, shift) -> np.ndarray:
    """A pose after a turn : (3,) rad about its own origin, and a shift : (3,) mm."""
    return rigid.moved(place, np.concatenate([turn, shift]))


def stamps(count: int) -> np.ndarray:
    return START_NS + PERIOD_NS * np.arange(count)


def optics(rig) -> Calibration:
    return Calibration({name: getattr(rig, name).optics.camera() for name in stereo_frames.CAMERAS})


def devices(rig, bits: int = 8) -> dict[str, Device]:
    return {name: Device(size=getattr(rig, name).optics.size, bits=bits) for name in stereo_frames.CAMERAS}


def draw(rig, poses, rng, missing=()):
    """Pairs of frames of poses; those missing don't show the target to camera 2."""
    for k, place in enumerate(poses):
        pair = [
            drawings.frame(getattr(rig, name).optics.camera(), [place], rig.target, 65.0, rng) for name in stereo_frames.CAMERAS
        ]
        yield pair[0], np.full_like(pair[1], 20) if k in missing else pair[1]


def film(folder: Path, rig, rng, count: int = 4, missing=()) -> Path:
    """A film of `places`."""
    pairs = draw(rig, places(count), rng, missing)
    captures.write_film(folder, pairs, stamps(count), optics(rig), devices(rig), "drawn")
    return folder


def blank(folder: Path, rig, count: int = 3, bits: int = 8) -> Path:
    """A film of grey frames, each brighter than the one before."""
    kind = np.uint8 if bits == 8 else np.uint16
    frames = [np.full(getattr(rig, name).optics.size[::-1], 10, kind) for name in stereo_frames.CAMERAS]
    pairs = ((frames[0] + kind(k), frames[1] + kind(2 * k)) for k in range(count))
    captures.write_film(folder, pairs, stamps(count), optics(rig), devices(rig, bits), "blank")
    return folder


def centres(rig, place) -> list[np.ndarray]:
    """Where each camera sees the circles of a pose : (3, 2) px."""
    points = rigid.apply(place, circle_layout.circle_centres(rig.target))
    return [getattr(rig, name).optics.camera().project(points) for name in stereo_frames.CAMERAS]
