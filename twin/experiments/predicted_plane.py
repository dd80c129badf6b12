"""The error of a plane that a rig will find, before anything is recorded, from its description; and what would lower it.

At places all over the view: the light that comes back, the noise and the modulation of the finest fringes in it, the phase's
error, and the plane's by the slope of the projector's column along the camera's ray, or row, or both as they are weighed by the
triangulation; and what a calibration with covariance lets the plane bend. Of Gray code alone it is the error of its cells.

A projector that flickers costs light, as exposures are set for its brightest frame. Errors of frames in a phase are the decoder's
to find, by four steps or more; what it leaves isn't counted, but by three steps all of them are.

Sources: docs/physics-optics.md for light and sensor; Greivenkamp 1984 for the phase's noise; Blom 1958 for the largest of n
normal numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Array
from recon.geometry.primitives import Plane
from recon.identification import rig_file
from recon.identification.estimates import Estimate, Findings
from recon.model.patterns import Axis, Fringes, GrayCode, Patterns
from recon.model.rig import CameraDevice, ProjectorDevice, Rig
from recon.optical_calibration import uncertainty as calibrated
from recon.structured_light.frame_errors import LEAST_STEPS
from scenes.kinds import plane
from twin.conditions import IDEAL, Frames
from twin.experiments import closed_forms, predicted_cells
from twin.experiments.predicted_cells import Light
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting
from twin.sensor import Exposure, electrons_per_radiance, noise_dn, number_per_electron

AXES: tuple[Axis, ...] = ("columns", "rows")  # in the order of a projector's coordinates
ON_RAYS = 1e-3  # error of camera 1's pixels over the projector's: their rays are exact
GRID = (17, 13)  # places over camera 1's image, across and down
WAVE = 512  # steps of a period
BRIGHTEST = 99.0  # percentile of the places, at which the exposure is set; there are fewer than pixels
STEP = 0.02  # relative, of the differences by which slopes are found
SIGMAS = 0.5  # likewise, of a measured number


@dataclass(frozen=True)
class Measurement:
    """What is to be measured, and how."""

    patterns: Patterns
    plate: plane.Config
    shooting: Shooting
    tracing: Tracing
    frames: Frames = IDEAL.frames


class Prediction(NamedTuple):
    """Errors of a plane's points, RMS over what camera and projector both see."""

    rms_mm: float
    noise_mm: float  # by the cameras' noise alone; 0 of Gray code alone, whose cells it may widen
    frames_mm: float  # by errors of frames alone, as far as the decoder can't find them
    mirrors_mm: float  # by the projector's raster alone, or by the cells of Gray code alone
    optics_mm: float  # by errors of the calibration alone, as they are expected; 0 if the rig has no covariance
    optics_sigma_mm2: float  # standard deviation of the square of that, from one calibration to the next
    modulation_dn: float  # median, of the axis that counts most
    exposure_s: float
    common_view: float  # of camera 1's pixels, on a plane that is larger than its view


def predict(rig: Rig, measurement: Measurement) -> Prediction:
    """Predict the RMS distance of points from the plane that they are of.

    Raises
    ------
    ValueError
        If camera 1 and the projector see nothing of it together, or one axis has fringes and the other a code alone.
    """
    patterns, shooting, sensor = measurement.patterns, measurement.shooting, rig.cam1.sensor
    fringed = {axis: patterns.has_fringes(axis) for axis in patterns.axes}
    if len(set(fringed.values())) > 1:
        axis, alone = (next(axis for axis in fringed if fringed[axis] is kind) for kind in (True, False))
        raise ValueError(
            f"patterns: expected fringes along both axes or Gray code alone, found fringes of {axis}, code of {alone}"
        )
    (flat,) = (shape for shape in plane.build(measurement.plate).shapes if isinstance(shape, Plane))
    points, slopes = _seen(rig, flat, measurement.plate)
    radiance = _radiance(rig, points, flat.normal, measurement.plate.reflectance)
    room = measurement.plate.reflectance * measurement.tracing.room_radiance * _passed(rig.cam1, points)
    sets = [closed_forms.fringes_of(patterns, axis) for axis in fringed if fringed[axis]]
    waves = [_wave(rig, fringes, points) for fringes in sets]
    peak = np.max([np.zeros(len(points)), *(wave.peak for wave in waves)], axis=0)
    if any(not isinstance(part, Fringes) for part in patterns.parts):
        peak = np.ones_like(peak)  # a code's stripes, or a uniform image
    electron = electrons_per_radiance(rig.cam1, rig.projector.wavelength_nm)
    bright = [part.count for part in patterns.parts if not isinstance(part, Fringes)] or [one.count for one in sets]
    lit = radiance * peak * (1 + measurement.frames.flicker * largest_normal(sum(bright)))
    brightest = float(np.percentile(lit + room, BRIGHTEST)) * electron  # a second
    longest_s = sensor.saturation_e / (brightest * shooting.gain)
    time_s = shooting.exposure_s or shooting.level * longest_s
    if time_s > longest_s:
        expected = f"expected {1e3 * longest_s:.3g} ms at most, by which bright places saturate"
        raise ValueError(f"shooting.exposure_s: {expected}, found {1e3 * time_s:.3g} ms")
    exposure = Exposure(time_s, shooting.gain, shooting.bits)
    light = Light(radiance * electron * time_s, room * electron * time_s + sensor.dark_current_e_per_s * time_s)
    mm_a_px = slopes.T[[AXES.index(axis) for axis in fringed]]
    found = (
        _by_fringes(rig, sets, waves, points, mm_a_px, light, exposure, measurement.frames)
        if sets
        else _by_cells(rig, patterns, points, mm_a_px, light, exposure)
    )
    bent2, bent2_sigma = _bent(rig, points, flat.normal, found.sigma_px)
    view = len(points) / (GRID[0] * GRID[1])
    return Prediction(
        float(np.sqrt(found.noise_mm**2 + found.frames_mm**2 + found.mirrors_mm**2 + bent2)),
        found.noise_mm,
        found.frames_mm,
        found.mirrors_mm,
        float(np.sqrt(bent2)),
        bent2_sigma,
        found.modulation_dn,
        time_s,
        view,
    )


def largest_normal(count: int) -> float:
    """The largest of some standard normal numbers, as it is expected, to 0.02."""
    return float(stats.norm.ppf((count - 0.375) / (count + 0.25)))


class _Found(NamedTuple):
    """Errors of a plane's points by what is projected, RMS over its places."""

    noise_mm: float
    frames_mm: float
    mirrors_mm: float
    modulation_dn: float  # median, of the axis that counts most
    sigma_px: dict[Axis, float]  # of the projector's coordinates


def _by_fringes(
    rig: Rig,
    sets: Sequence[Fringes],
    waves: "Sequence[_Wave]",
    points: Array,
    mm_a_px: Array,
    light: Light,
    exposure: Exposure,
    frames: Frames,
) -> _Found:
    """By the phases of fringes of each axis, as they are weighed; mm_a_px : (axes, n)."""
    per_electron = number_per_electron(rig.cam1.sensor, exposure)
    by_noise, by_frames, by_mirrors, modulations, sigma_px = [], [], [], [], dict[Axis, float]()
    for fringes, wave, slope in zip(sets, waves, mm_a_px, strict=True):
        weighed = wave.mean - wave.second / 2  # light at the steps by which the phase is known, where it is steep: sin^2
        counted_e = light.projector * weighed + light.room
        modulations.append(light.projector * wave.amplitude * per_electron)
        noise, mm_a_rad = noise_dn(np.float32(counted_e), rig.cam1.sensor, exposure), fringes.pitch / (2 * np.pi) * slope
        phase = np.sqrt(2 / fringes.steps) * noise / modulations[-1]
        sigma_px[fringes.axis] = float(np.median(phase)) * fringes.pitch / (2 * np.pi)
        by_noise.append(mm_a_rad * phase)
        stray = frames.stray_dn * 2 ** (exposure.bits - 8) / modulations[-1]
        unfound = closed_forms.phase_sigma_of_frames(
            fringes.steps, frames.flicker, stray, frames.shift, wave.mean / wave.amplitude
        )
        by_frames.append(mm_a_rad * unfound * (fringes.steps < LEAST_STEPS))
        by_mirrors.append(mm_a_rad * closed_forms.raster_sigma(rig, fringes, points))
    weights = np.array(by_noise) ** -2.0
    weights /= weights.sum(axis=0)
    noise_mm, frames_mm, mirrors_mm = (
        float(np.sqrt(np.mean(np.nansum((weights * one) ** 2, axis=0)))) for one in (by_noise, by_frames, by_mirrors)
    )
    modulation = float(np.median(modulations[int(np.argmax(weights.mean(axis=1)))]))
    return _Found(noise_mm, frames_mm, mirrors_mm, modulation, sigma_px)


def _by_cells(rig: Rig, patterns: Patterns, points: Array, mm_a_px: Array, light: Light, exposure: Exposure) -> _Found:
    """By the cells of a code of each axis, as they are weighed; mm_a_px : (axes, n). ValueError where no bit is read."""
    places = rig.projector.optics.camera().project(points)
    codes = [next(part for part in patterns.parts if isinstance(part, GrayCode) and part.axis == axis) for axis in patterns.axes]
    sigma_px, (off, weight) = dict[Axis, float](), np.zeros((2, len(points), 1))
    for code, slope in zip(codes, mm_a_px[..., None], strict=True):
        read = predicted_cells.read(rig, code, places[:, AXES.index(code.axis)], points, light, exposure)
        known = np.isfinite(read.error)
        if not known.any():
            raise ValueError(f"patterns: expected a code of {code.axis} that can be read, found it too dark or too blurred")
        inverse = np.where(known, read.sigma, np.inf) ** -2.0 / slope
        off, weight = off + inverse * np.where(known, read.error, 0), weight + inverse / slope
        sigma_px[code.axis] = float(np.median(read.sigma[known]))
    cells_mm = float(np.sqrt(np.mean((off[weight > 0] / weight[weight > 0]) ** 2)))
    modulation = float(np.median(light.projector)) * (1 - 1 / rig.projector.contrast) / 2
    return _Found(0.0, 0.0, cells_mm, modulation * number_per_electron(rig.cam1.sensor, exposure), sigma_px)


def _seen(rig: Rig, flat: Plane, plate: plane.Config) -> tuple[Array, Array]:
    """Points : (n, 3) mm of the plate that both devices see; the plane's error, mm, for a column's, px, and a row's : (n, 2)."""
    camera, projector = rig.cam1.optics.camera(), rig.projector.optics.camera()
    across, down = ((np.arange(steps) + 0.5) / steps * length - 0.5 for length, steps in zip(camera.size, GRID, strict=True))
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    points, mm_a_px = closed_forms.seen_points(camera, projector, flat, pixels)
    local = rigid.apply(rigid.invert(plane.tilted(plate.centre_mm, plate.tilt_deg)), points)
    seen = (np.abs(local[:, :2]) < np.array(plate.size_mm) / 2).all(axis=1)
    if not seen.any():
        raise ValueError("plate: expected it in view of camera 1 and the projector, found it in none or one of them")
    return points[seen], mm_a_px[seen]


def _radiance(rig: Rig, points: Array, normal: Array, reflectance: float) -> Array:
    """Radiance : (n,) W/mm^2/sr of a matt surface, all of the projector on, as camera 1's lens lets it pass."""
    optics, lens = rig.projector.optics, rig.projector.lens
    camera = optics.camera()
    local = rigid.apply(camera.camera_from_world, points)
    distance = np.linalg.norm(local, axis=1)
    slant = local[:, 2] / distance
    facing = np.abs((camera.centre - points) @ normal) / distance
    (width, height), (fx, fy) = optics.size, optics.focal_px
    full = rig.projector.radiant_flux_w * fx * fy / (width * height)
    irradiance = full * facing / slant**3 / distance**2 * (1 - lens.vignetting * _corner2(rig.projector, points))
    return reflectance / np.pi * irradiance * _passed(rig.cam1, points)


def _passed(device: CameraDevice, points: Array) -> Array:
    """Share : (n,) of the light that a camera's lens lets pass on the way from points."""
    local = rigid.apply(device.optics.camera().camera_from_world, points)
    cosine2 = local[:, 2] ** 2 / (local**2).sum(axis=1)
    return cosine2**2 * (1 - device.lens.vignetting * _corner2(device, points))


def _corner2(device: CameraDevice | ProjectorDevice, points: Array) -> Array:
    """Squared distance : (n,) of points' pixels from the image's middle, 1 in a corner."""
    camera = device.optics.camera()
    middle = (np.array(camera.size) - 1) / 2
    return ((camera.project(points) - middle) ** 2).sum(axis=1) / (middle @ middle)


class _Wave(NamedTuple):
    """Fringes' light at points with all blur, 1 for a pixel fully on. All (n,)."""

    mean: Array
    amplitude: Array
    second: Array  # harmonic
    peak: Array


def _wave(rig: Rig, fringes: Fringes, points: Array) -> _Wave:
    harmonics = np.fft.rfft(closed_forms.waveform(rig, fringes, WAVE)) / WAVE
    waves = np.arange(len(harmonics)) / fringes.pitch
    blurred = harmonics * np.sinc(waves) * closed_forms.transfer(rig, points, waves)
    peak = np.fft.irfft(blurred * WAVE, axis=-1).max(axis=-1)
    return _Wave(blurred[:, 0].real, 2 * np.abs(blurred[:, 1]), 2 * blurred[:, 2].real, peak)


def _bent(rig: Rig, points: Array, normal: Array, sigma_px: dict[Axis, float]) -> tuple[float, float]:
    """Mean square, mm^2, of a plane's points : (n, 3) about the plane fitted to them, and its standard deviation.

    Points are on camera 1's rays, by the projector's columns and rows with weights by their standard deviations.

    By errors of the calibration, which are normal: of `z^T M z` with a covariance C, these are `tr(M C)` and
    `sqrt(2 tr(M C M C))`.
    """
    calibration = rig.calibration()
    if calibration.uncertainty is None:
        return 0.0, 0.0
    by_axis = [sigma_px.get(axis, np.inf) / min(sigma_px.values()) for axis in AXES]
    slopes = calibrated.point_slopes(calibration, "cam1", "projector", points, (ON_RAYS, by_axis))
    along = np.einsum("i,nig->ng", normal, slopes)
    plane_terms = np.column_stack([np.ones(len(points)), points[:, :2]])  # in z a plane's, as it stands before the camera
    left = along - plane_terms @ np.linalg.lstsq(plane_terms, along)[0]
    product = left.T @ left / len(points) @ calibration.uncertainty.covariance
    return float(np.trace(product)), float(np.sqrt(2 * np.trace(product @ product)))


def uncertainty(rig: Rig, measurement: Measurement) -> float:
    """Standard deviation of the predicted RMS, mm, by those of the rig's measured numbers, which err independently.

    Optics as calibrated err together: what they do to the plane differs from calibration to calibration.
    """
    now = predict(rig, measurement)
    total = (now.optics_sigma_mm2 / (2 * now.rms_mm)) ** 2
    for name, known in rig.measured.items():
        if known.sigma == 0 or (rig.optics_covariance is not None and ".optics." in name):
            continue
        ends = [_changed(rig, name, side * SIGMAS * known.sigma) for side in (-1, 1)]
        way = ends[1].number(name) - ends[0].number(name)  # less at a bound
        slope = np.diff([predict(end, measurement).rms_mm for end in ends]).item() / way if way else 0.0
        total += (slope * known.sigma) ** 2
    return float(np.sqrt(total))


def _changed(rig: Rig, name: str, by: float) -> Rig:
    """The rig with one number changed, as far as it may be."""
    value = rig.number(name)
    for changed in (value + by, value):  # one that can't be is left
        try:
            return rig_file.apply(rig, Findings({name: Estimate(changed, 0.0, "a change")}))
        except InputError:
            continue
    return rig


def elasticities(rig: Rig, measurement: Measurement, names: Sequence[str]) -> dict[str, float]:
    """Relative change of the RMS by a relative change of each number : d ln rms / d ln number, the largest first."""
    found = {}
    for name in names:
        ends = [_changed(rig, name, side * STEP * rig.number(name)) for side in (-1, 1)]
        way = np.diff(np.log([max(end.number(name), 1e-12) for end in ends])).item()
        errors = np.log([predict(end, measurement).rms_mm for end in ends])
        found[name] = float(np.diff(errors).item() / way) if way else 0.0
    return dict(sorted(found.items(), key=lambda pair: -abs(pair[1])))
