"""A capture rendered again: its surface and light as its images show them, under the same patterns, by a rig's description.

No truth is read. Both captures, the real and the rendered one, go through the same pipeline.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from recon.capture import calibration_files, surface_part
from recon.capture.manifest import Device, read_manifest
from recon.capture.surface_part import SurfaceCapture
from recon.errors import InputError
from recon.model.rig import Rig
from recon.session import skin_step
from recon.session.skin_step import Skin
from recon.session.watch import SILENT, Watch
from twin.conditions import Conditions
from twin.evaluation import likeness
from twin.evaluation.likeness import Likeness, Taken
from twin.optics import seen_surface, surface_session
from twin.optics.light_transport import Tracing
from twin.optics.seen_surface import SeenScene
from twin.optics.surface_session import CameraName, Shooting
from twin.sensor import Exposure

UNKNOWN_S = 0.01  # exposure where a capture doesn't have it: the flux is set by the images anyway


@dataclass(frozen=True)
class Rerendered:
    """A real capture, the twin's, and their likeness."""

    real: Taken
    twin: Taken
    likeness: Likeness
    seen: SeenScene


def rerender(
    capture: Path,
    rig: Rig,
    conditions: Conditions,
    camera: CameraName,
    tracing: Tracing,
    seed: int,
    watch: Watch = SILENT,
) -> Rerendered:
    """Reconstruct a capture's surface, render the capture again, reconstruct that, and compare both.

    Parameters
    ----------
    rig : by whose optics both are reconstructed
    conditions : of the frames, drawn anew
    tracing : of the renders; the room's light is taken from the images

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, is of devices of other sizes, has more bits than the rig's camera, or shows no
        surface, or one whose white is clipped everywhere.
    """
    shots, device = read(capture, rig, camera)
    exposure = Exposure(device.exposure_s or UNKNOWN_S, device.gain or 1.0, device.bits)
    with watch.busy("reconstructing the surface"):
        skin = skin_step.reconstruct(shots, camera)
    with watch.busy("finding its reflectance"):
        seen = seen_surface.scene_of(shots, skin, rig, camera, exposure, tracing, seed)
    pixels = np.count_nonzero(seen.inside)
    watch.say(f"scene       {pixels} px of a surface, room light {seen.room_lux:.3g} lux, {seen.reflectance_in_words}")
    shooting = Shooting(exposure_s=exposure.time_s, gain=exposure.gain, bits=exposure.bits)
    lit = tracing.model_copy(update={"room_lux": seen.room_lux})
    with watch.busy(f"rendering {shots.patterns.count} patterns"):
        view = surface_session.shoot(seen.rig, seen.scene, shots.patterns, camera, lit, shooting, seed, conditions)
    with watch.busy("reconstructing the rendered surface"):
        again = skin_step.reconstruct(replace(shots, images=view.images, name="the rendered capture"), camera)
    with watch.busy("comparing"):
        real, twin = _taken(shots.images, shots, skin, rig, camera), _taken(view.images, shots, again, rig, camera)
        found = likeness.compare(real, twin, seen.inside, conditions.frames)
    return Rerendered(real, twin, found, seen)


def read(capture: Path, rig: Rig, camera: CameraName) -> tuple[SurfaceCapture, Device]:
    """A capture's surface with the rig's own optics for a calibration, and the camera as it was set; InputError as above."""
    manifest = read_manifest(capture)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "optics.yaml"
        calibration_files.write(file, surface_session.calibration_of(rig))
        shots = surface_part.read_surface(capture, camera, file)
    device, adc_bits = manifest.devices_of("surface")[camera], getattr(rig, camera).sensor.adc_bits
    if device.bits > adc_bits:
        raise InputError(f"rig.{camera}.sensor.adc_bits: expected the {device.bits} bits of the images or more, found {adc_bits}")
    return shots, device


def _taken(images: NDArray, shots: SurfaceCapture, skin: Skin, rig: Rig, camera: CameraName) -> Taken:
    away = skin.points.points - getattr(rig, camera).optics.camera().centre.astype(np.float32)
    light = seen_surface.seen_light(images, shots.patterns, skin.found, rig.projector.gamma, 2.0**shots.bits - 1)
    return Taken(images, shots.patterns, shots.bits, skin.found, skin.points, np.linalg.norm(away, axis=-1), light)
