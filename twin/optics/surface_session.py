"""The surface part of a session: images of a scene under a pattern sequence, and their truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Annotated, Literal

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon import arguments
from recon.capture.manifest import Device
from recon.errors import InputError
from recon.model.calibration import Calibration
from recon.model.patterns import Fringes, Patterns
from recon.model.rig import CameraDevice, Part, Positive, Rig
from scenes.scene_types import Scene
from twin.conditions import IDEAL, Conditions, as_skin, draw
from twin.optics.disturbed_light import emitted, with_stray
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Images, Tracing, render
from twin.optics.raster import Light
from twin.optics.ray_world import build_world, reshape_things, translucent, visible
from twin.optics.surface_truth import SurfaceTruth, surface_truth
from twin.sensor import Exposure, Numbers, auto_exposure, electrons_per_radiance, expose, noise_dn, number_per_electron
from twin.session import Session, describe

CameraName = Literal["cam1", "cam2"]


class Shooting(Part):
    """Settings of the cameras' shots."""

    exposure_s: Positive | None = None  # if not given, set for the scene: see level
    level: Annotated[float, Field(gt=0, le=1)] = 0.9  # of full scale, for the brightest thousandth of the pixels
    gain: Positive = 1.0  # linear; 1 fills the range with the sensor's saturation charge
    bits: Literal[8, 10, 12] = 8  # of the images; at most the sensor's ADC has


@dataclass(frozen=True)
class View:
    """One camera's share of a rendered surface capture."""

    images: Numbers  # (n, h, w)
    exposure: Exposure
    truth: SurfaceTruth
    limit_px: Images  # (h, w, 2) see `noise_limit_px`


def shoot(
    rig: Rig,
    scene: Scene,
    patterns: Patterns,
    camera: CameraName,
    tracing: Tracing,
    shooting: Shooting,
    seed: int,
    conditions: Conditions = IDEAL,
    moments: Sequence[Scene] = (),
) -> View:
    """Render a camera's view of a pattern sequence, and take the images with its sensor.

    The same seed gives the same bytes. Rendering noise, sensor noise and the two cameras draw from separate streams; errors of
    frames are the same for both cameras.

    moments : (n,) the scene as it is in each of the images, where it moves; the truth is that of `scene`.
    """
    arguments.of_kind("render: rig", rig, Rig, way="sonotwin.read_rig reads one by name or file")
    arguments.of_kind("render: scene", scene, Scene, way="sonotwin.build_scene builds one")
    arguments.of_kind("render: patterns", patterns, Patterns, way="sonotwin.read_patterns reads them by name or file")
    arguments.of_kind("render: tracing", tracing, Tracing)
    arguments.of_kind("render: shooting", shooting, Shooting)
    arguments.whole("render: seed", seed, 0, 2**63 - 1)
    if not isinstance(camera, str) or camera not in ("cam1", "cam2"):
        raise InputError(f"render: camera: expected cam1 or cam2, found {arguments.described(camera)}")
    device: CameraDevice = getattr(rig, camera)
    light_seed, sensor_seed = np.random.SeedSequence([seed, ("cam1", "cam2").index(camera)]).generate_state(2).tolist()
    optics = camera_optics(rig, camera)
    scene = as_skin(scene, conditions.skin, seed)
    world, projector = build_world(moments[0] if moments else scene), ProjectorOptics.of(rig.projector)
    frames = draw(conditions.frames, patterns.count, seed)
    light = emitted(patterns, rig.projector, frames)
    spreading = translucent(scene, world)
    if moments:
        radiance = np.concatenate(
            [
                render(_at_moment(one, world), optics, projector, _of_one(light, k), tracing, light_seed, spreading)
                for k, one in enumerate(moments)
            ]
        )
        reshape_things(world, scene)
    else:
        radiance = render(world, optics, projector, light, tracing, light_seed, spreading)
    wavelength = rig.projector.wavelength_nm
    time_s = shooting.exposure_s or auto_exposure(radiance, device, wavelength, level=shooting.level / shooting.gain)
    exposure = Exposure(time_s, shooting.gain, shooting.bits)
    return View(
        expose(with_stray(radiance, frames.stray_dn, device, wavelength, exposure), device, wavelength, exposure, sensor_seed),
        exposure,
        surface_truth(world, device.optics.camera(), rig.projector.optics.camera()),
        noise_limit_px(radiance, patterns, device, wavelength, exposure),
    )


def _at_moment(moment: Scene, world: mi.Scene) -> mi.Scene:
    reshape_things(world, moment)
    return world


def _of_one(light: Light, number: int) -> Light:
    """The light of one of the patterns."""
    return replace(light, axes=light.axes[number : number + 1], profiles=light.profiles[number : number + 1])


def camera_optics(rig: Rig, camera: CameraName) -> CameraOptics:
    """A camera's optics.

    Raises
    ------
    InputError
        If there are pixels that no ray reaches.
    """
    optics = CameraOptics.of(getattr(rig, camera))
    unreached = np.count_nonzero(np.isnan(optics.transmission))
    if unreached:
        raise InputError(
            f"rig.{camera}.optics.distortion: expected a ray for every pixel, found {unreached} px that no ray reaches"
        )
    return optics


def noise_limit_px(
    radiance: Images, patterns: Patterns, device: CameraDevice, wavelength_nm: float, exposure: Exposure
) -> Images:
    """Standard deviation of the decoded projector column and row that the sensor's noise alone allows : (h, w, 2) px.

    Infinite in the dark, and for an axis without fringes; of several pitches the finest counts.
    """
    electrons = radiance * np.float32(electrons_per_radiance(device, wavelength_nm) * exposure.time_s)
    limits = np.full((*radiance.shape[1:], 2), np.inf, np.float32)
    for number, axis in enumerate(("columns", "rows")):
        sets = [(part, place) for part, place in patterns.slices() if isinstance(part, Fringes) and part.axis == axis]
        if sets:
            fringes, place = min(sets, key=lambda pair: pair[0].pitch)
            sigma = _phase_limit(electrons[place], fringes.shifts, device, exposure)
            limits[..., number] = fringes.pitch / (2 * np.pi) * sigma
    return limits


def _phase_limit(electrons: Images, shifts: NDArray[np.float64], device: CameraDevice, exposure: Exposure) -> Images:
    """Standard deviation of the least-squares phase : (h, w) rad, from noise-free N-step images : (n, h, w) electrons.

    The noise of each image carried through the fit: a change dI_k turns the phase by `-2/(N B) sin(phase + shift_k) dI_k`.
    """
    count = len(shifts)
    phasor = 2 / count * sum(wave * image for wave, image in zip(np.exp(-1j * shifts), electrons, strict=True))
    dark = device.sensor.dark_current_e_per_s * exposure.time_s
    variance = sum(
        (2 / count * np.sin(np.angle(phasor) + shift) * noise_dn(image + dark, device.sensor, exposure)) ** 2
        for shift, image in zip(shifts, electrons, strict=True)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(variance) / (np.abs(phasor) * number_per_electron(device.sensor, exposure))


def calibration_of(rig: Rig) -> Calibration:
    """The rig's true calibration."""
    devices = {"cam1": rig.cam1, "cam2": rig.cam2, "projector": rig.projector}
    return Calibration({name: device.optics.camera() for name, device in devices.items()})


def write_session(
    session: Session,
    rig: Rig,
    calibrated: Rig,
    scene: Scene,
    patterns: Patterns,
    views: Mapping[CameraName, View],
    standing: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
) -> None:
    """Write a surface and its truth; a calibration that has been measured for a capture that is added to stays in it.

    rig, calibrated : as it took the images, and as it was when it was calibrated.
    standing : poses `world_from_target` : (4, 4) mm of bodies beside the scene, by name
    """
    devices = {"projector": Device(size=patterns.projector_size)}
    for camera, view in views.items():
        devices[camera] = device_of(view.images.shape[:0:-1], view.exposure)
    with session.write(describe_visible(scene)) as (capture, truth):
        truth.write_optics(calibration_of(rig))
        for camera, view in views.items():
            arrays: dict[str, NDArray] = {field.name: getattr(view.truth, field.name) for field in fields(view.truth)}
            truth.write_arrays(f"surface/{camera}.npz", {**arrays, "limit_px": view.limit_px})
        for name, pose in standing.items():
            truth.write_arrays(f"surface/bodies/{name}.npz", {"world_from_target": pose})
        capture.complete_calibration(calibration_of(calibrated))
        capture.add_surface({camera: view.images for camera, view in views.items()}, patterns, devices)


def device_of(size: tuple[int, ...], exposure: Exposure) -> Device:
    """A camera in the manifest, as it was set."""
    return Device(size=size, bits=exposure.bits, exposure_s=exposure.time_s, gain=exposure.gain)


def describe_visible(scene: Scene) -> dict[str, object]:
    """A scene as cameras see it: its visible things by number."""
    return describe(scene, things=[thing.name for thing in visible(scene)])
