"""Plausible mistakes in calibrations: units, frames, exchanged devices, those of another day."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from campaign.capture_mistakes import UNITS, Change, Mistake, Rng
from recon.capture import calibration_files, probe_files
from recon.geometry import rigid
from recon.model.calibration import Calibration
from recon.model.lengths import UNIT_KEY

Array = NDArray[np.float64]


def optics(path: str, how: Callable[[Calibration, Rng], Calibration]) -> Change:
    """A changed calibration of cameras and projector."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        found = how(calibration_files.read(folder / path), rng)
        (folder / path).unlink()
        calibration_files.write(folder / path, found)
        _leave_unit_out(folder / path)
        return ()

    return change


def _leave_unit_out(path: Path) -> None:
    """Take the unit out of a file that states it, as who mistakes it doesn't."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    path.write_text("".join(line for line in lines if not line.startswith(UNIT_KEY)), encoding="utf-8")


def _of_cameras(how: Callable[[str, Any], Any], calibration: Calibration, rng: Rng) -> Calibration:
    return replace(calibration, cameras={name: how(name, camera) for name, camera in calibration.cameras.items()})


def in_unit(factor: float) -> Callable[[Calibration, Rng], Calibration]:
    """Translations in another unit."""

    def how(name: str, camera: Any) -> Any:
        place = camera.camera_from_world.copy()
        place[:3, 3] *= factor
        return replace(camera, camera_from_world=place)

    return partial(_of_cameras, how)


def inverse(calibration: Calibration, rng: Rng) -> Calibration:
    """Poses from the device into the world."""
    return _of_cameras(
        lambda name, camera: replace(camera, camera_from_world=rigid.invert(camera.camera_from_world)), calibration, rng
    )


def exchanged(first: str, second: str) -> Callable[[Calibration, Rng], Calibration]:
    """Two devices exchanged; a device that has no such rival stays."""

    def how(calibration: Calibration, rng: Rng) -> Calibration:
        cameras = dict(calibration.cameras)
        a, b = cameras[first], cameras[second]
        cameras[first], cameras[second] = b, a
        return Calibration(cameras)

    return how


def of_another_day(calibration: Calibration, rng: Rng) -> Calibration:
    """Of the same devices, mounted anew: each but the first turned by some degrees."""

    def how(name: str, camera: Any) -> Any:
        if name == "cam1":
            return camera
        step = np.concatenate([np.radians(rng.normal(0, 1.0, 3)), rng.normal(0, 5, 3)])
        return replace(camera, camera_from_world=rigid.moved(camera.camera_from_world, step))

    return _of_cameras(how, calibration, rng)


def without_lens(calibration: Calibration, rng: Rng) -> Calibration:
    """Without distortion."""
    return _of_cameras(lambda name, camera: replace(camera, distortion=np.zeros(5)), calibration, rng)


def of_half_size(calibration: Calibration, rng: Rng) -> Calibration:
    """Focal lengths and centres of images of half the size."""

    def how(name: str, camera: Any) -> Any:
        matrix = camera.matrix.copy()
        matrix[:2] /= 2
        return replace(camera, matrix=matrix) if name != "projector" else camera

    return _of_cameras(how, calibration, rng)


def probe(path: str, how: Callable[[Any], Any]) -> Change:
    """A changed calibration of the probe."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        found = how(probe_files.read(folder / path))
        (folder / path).unlink()
        probe_files.write(folder / path, found)
        _leave_unit_out(folder / path)
        return ()

    return change


def _probe_turned(turn: Array) -> Callable[[Any], Any]:
    return lambda found: replace(found, target_from_image=found.target_from_image @ turn)


def _scaled_translation(factor: float) -> Callable[[Any], Any]:
    def how(found: Any) -> Any:
        place = found.target_from_image.copy()
        place[:3, 3] *= factor
        return replace(found, target_from_image=place)

    return how


ALIKE = np.diag([-1.0, 1, -1, 1])  # a probe held the other way round


def of_probe(path: str) -> list[Mistake]:
    """Mistakes in a calibration of the probe that is given."""
    scale, place = r"scale|sx|sy|mm/px|unit", r"unit|bracket|target_from_image"
    return [
        *(
            Mistake("units", f"scales in {name} a pixel", scale, probe(path, lambda p, f=factor: replace(p, scale=p.scale * f)))
            for name, factor in UNITS.items()
        ),
        *(
            Mistake("units", f"the probe's translation in {name}", place, probe(path, _scaled_translation(factor)))
            for name, factor in UNITS.items()
        ),
        Mistake("frames", "image_from_target given", r"invers|target_from_image|bracket|frame", probe(
            path, lambda p: replace(p, target_from_image=rigid.invert(p.target_from_image)))),
        Mistake("field", "sx and sy exchanged", scale, probe(path, lambda p: replace(p, scale=p.scale[::-1]))),
        Mistake("mirrored", "the probe turned by 180 degrees", r"turn|mirror|side|bracket", probe(path, _probe_turned(ALIKE))),
        Mistake("device", "another probe's scale", scale, probe(path, lambda p: replace(p, scale=p.scale * 1.6))),
        Mistake("field", "the sound of water for tissue's", r"sound|speed|m/s", probe(
            path, lambda p: replace(p, speed_m_s=p.speed_m_s * 0.96))),
    ]  # fmt: skip


def of_optics(path: str, devices: tuple[str, ...]) -> list[Mistake]:
    """Mistakes in a calibration of cameras and projector."""
    words = r"unit|baseline|translation|metres"
    found = [Mistake("units", f"translations in {name}", words, optics(path, in_unit(f))) for name, f in UNITS.items()]
    found += [
        Mistake("frames", "world_from_device given", r"invers|calibration|behind|common|view|frame", optics(path, inverse)),
        Mistake("device", "a calibration of another day", r"calibration|moved|drift|agree|another", optics(path, of_another_day)),
        Mistake("field", "lenses left out", r"calibration|distortion|lens|agree", optics(path, without_lens)),
        Mistake("field", "a camera matrix of half the size", r"calibration|size|focal|common|view", optics(path, of_half_size)),
    ]
    if len(devices) > 1:
        found.append(
            Mistake("device", f"{devices[0]} and {devices[1]} exchanged", r"exchang|swap|calibration|agree|common|order|another",
                    optics(path, exchanged(*devices[:2])))
        )  # fmt: skip
    return found
