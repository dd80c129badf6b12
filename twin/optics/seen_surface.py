"""A capture's surface as a scene: its shape by the fringes, its reflectance by the light that came back.

A pixel's images at places of a projector's image that are far inside of bright and of dark stripes show its light under a white
and under a black image, whatever gamma and blur are. Over the light that the rig would send there, that is the reflectance;
what the dark image has beyond the black level is the room's light. So neither fringes nor edges are used for what they test.

Images show the product of flux and reflectance alone: the flux is set so that bright places have a usual one.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.capture.surface_part import SurfaceCapture
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.patterns import Axis, Fringes, GrayCode, Patterns, Uniform
from recon.model.rig import Rig
from recon.session.skin_step import Skin
from recon.structured_light import surface_mesh
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.triangulate import PointMap
from scenes import solid_meshes
from scenes.scene_types import Material, Scene, Thing
from twin.optics.instruments import ProjectorOptics
from twin.optics.light_transport import LUMENS_PER_WATT, Tracing, render
from twin.optics.raster import Light
from twin.optics.ray_world import build_world
from twin.optics.surface_session import CameraName, camera_optics
from twin.sensor import Exposure, electrons_per_radiance, number_per_electron

Array = NDArray[np.float64]
Image = NDArray[np.float32]  # (h, w)

INSIDE_PX = 4.0  # projector px from an edge, and half a period of the fringes, from which on a place counts as inside a stripe
FAR_PX = 64.0  # projector px from an edge, from which on farther ones count no more
BRIGHT = 99.5  # percentile of the reflectances, which gets
USUAL = 0.8  # this one, of plaster or paper
EVEN = 0.5  # reflectance of a first render
SHARPEST = 2.0  # factor by which the blur of rendering is undone at most
SLOPE = 0.02  # rad, of the surface's slopes by the points' noise after smoothing
LEAST_PX, MOST_PX = 0.7, 4.0  # camera px, standard deviation of that smoothing
BEHIND_MM, CLOTH_MM = 100.0, 5000.0  # distance and size of a black cloth behind it
SHIFTED = 5.0  # standard deviations by which smoothing moves a point at most; farther ones lie at a step of the surface


class SeenLight(NamedTuple):
    """Light of each pixel under a white and under a black image of the projector. Both (h, w) DN, NaN where unknown."""

    bright: Image
    dark: Image


class Edges(NamedTuple):
    """A stripe pattern's place in a sequence."""

    number: int  # of the image
    axis: Axis
    inside_px: Array  # (length,) distance of each projector px from the nearest edge, positive in the light
    narrowest_px: float  # stripe
    pitch: float  # of the code; infinite for a uniform image


@dataclass(frozen=True)
class SeenScene:
    """A scene as a capture shows it, and the light in which it does."""

    rig: Rig  # with the flux by which bright places have a usual reflectance
    scene: Scene
    room_lux: float
    inside: NDArray[np.bool_]  # (h, w) pixels whose surroundings are on the surface, and alike on it


def stripes(patterns: Patterns) -> Iterator[Edges]:
    """Binary images of a sequence: bits of Gray code, and uniform images that are white or black."""
    for part, place in patterns.slices():
        length = patterns.length(part.axis)
        if isinstance(part, Uniform) and part.level in (0, 1):
            yield Edges(place.start, part.axis, np.full(length, np.inf if part.level else -np.inf), np.inf, np.inf)
        if isinstance(part, GrayCode):
            for k, profile in enumerate(part.profiles(length)):
                lit = profile > 0.5
                if lit.all() or not lit.any():
                    yield Edges(place.start + k, part.axis, np.full(length, np.inf if lit.all() else -np.inf), np.inf, part.pitch)
                    continue
                edges = np.flatnonzero(np.diff(lit)) + 0.5
                signed = np.where(lit, 1, -1) * np.abs(np.arange(length)[:, None] - edges).min(axis=1)
                narrowest = float(np.diff(edges).min()) if len(edges) > 1 else float(length)
                yield Edges(place.start + k, part.axis, signed, narrowest, part.pitch)


def inside_of(edges: Edges, found: ProjectorMap) -> Image:
    """Distance of each pixel : (h, w) projector px from the nearest edge, positive in the light; NaN where it isn't known."""
    x = found.columns if edges.axis == "columns" else found.rows
    assert x is not None
    if np.isinf(edges.inside_px).all():
        return np.where(np.isfinite(x), np.float32(edges.inside_px[0]), np.float32(np.nan))
    return np.interp(x, np.arange(len(edges.inside_px)), edges.inside_px).astype(np.float32)


def seen_light(images: NDArray, patterns: Patterns, found: ProjectorMap, gamma: float) -> SeenLight:
    """Light of pixels under a white and a black image, by the images whose stripes they lie inside of.

    Of a sequence without any such the fringes tell it, by the projector's gamma and without its blur.
    """
    shape = images.shape[1:]
    sums, weights = np.zeros((2, *shape), np.float32), np.zeros((2, *shape), np.float32)
    axes = [axis for axis, x in (("columns", found.columns), ("rows", found.rows)) if x is not None]
    for edges in stripes(patterns):
        if edges.axis not in axes:
            continue
        inside = inside_of(edges, found)
        least = INSIDE_PX if np.isinf(edges.pitch) else max(INSIDE_PX, edges.pitch / 2)
        weight = np.where(np.abs(inside) >= least, np.minimum(np.abs(inside), FAR_PX), 0)
        for k, side in enumerate((inside < 0, inside > 0)):
            weights[k] += weight * side
            sums[k] += weight * side * images[edges.number]
    if not weights.any():
        return _by_fringes(images, patterns, found, gamma)
    with np.errstate(invalid="ignore"):
        dark, bright = sums / np.where(weights > 0, weights, np.float32(np.nan))
    return SeenLight(bright, dark)


def _by_fringes(images: NDArray, patterns: Patterns, found: ProjectorMap, gamma: float) -> SeenLight:
    """The same by least squares of the first axis's fringes behind gamma."""
    axis = patterns.axes[0]
    x = found.columns if axis == "columns" else found.rows
    assert x is not None
    moments = np.zeros((5, *x.shape))
    for part, place in patterns.slices():
        if not isinstance(part, Fringes) or part.axis != axis:
            continue
        phase = 2 * np.pi * (x.astype(float) - part.zero(patterns.length(axis))) / part.pitch
        for shift, image in zip(part.shifts, images[place], strict=True):
            light, seen = ((1 + np.cos(phase + shift)) / 2) ** gamma, image.astype(float)
            moments += np.stack([np.ones_like(light), light, light**2, seen, seen * light])
    one, once, twice, level, product = moments
    slope = (product - once * level / one) / (twice - once**2 / one)
    dark = (level - slope * once) / one
    return SeenLight(np.float32(dark + slope), np.float32(dark))


def scene_of(
    shots: SurfaceCapture, skin: Skin, rig: Rig, camera: CameraName, exposure: Exposure, tracing: Tracing, seed: int
) -> SeenScene:
    """The scene that a capture shows.

    Parameters
    ----------
    skin : by the rig's own optics
    exposure : of the images
    tracing : of the renders by which the reflectance is found; the room's light is not theirs but found

    Raises
    ------
    InputError
        If there are pixels that no ray reaches.
    """
    device = getattr(rig, camera)
    points, inside = smoothed(skin.points, device.optics.camera())
    mesh = surface_mesh.mesh(PointMap(points, skin.points.sigma), device.optics.camera())
    u, v = np.rint(device.optics.camera().project(mesh.vertices)).astype(int).T
    light = seen_light(shots.images, shots.patterns, skin.found, rig.projector.gamma)
    optics = camera_optics(rig, camera)
    per_radiance = (
        electrons_per_radiance(device, rig.projector.wavelength_nm)
        * exposure.time_s
        * number_per_electron(device.sensor, exposure)
    )
    white = (light.bright - light.dark) / np.float32(per_radiance)
    unlit = tracing.model_copy(update={"room_lux": 0.0, "bounces": 1})

    def lit(albedo: Image) -> Image:
        """Radiance : (h, w) under a white image, less that under a black one."""
        thing = Thing("surface", mesh, Material(EVEN), albedo[v, u])
        size = rig.projector.optics.size
        all_on = Light.of_profiles(size, [("columns", True, np.ones(size[0], np.float32))], rig.projector)
        shown = render(build_world(Scene("seen", (thing,))), optics, ProjectorOptics.of(rig.projector), all_on, unlit, seed)[0]
        return shown * np.float32(1 - 1 / rig.projector.contrast)

    with np.errstate(divide="ignore", invalid="ignore"):
        albedo = EVEN * white / lit(np.full(white.shape, np.float32(EVEN)))
    known = np.isfinite(albedo) & (albedo > 0) & np.isfinite(points[..., 0])
    scale = float(np.percentile(albedo[known], BRIGHT)) / USUAL
    albedo = np.clip(_filled(np.where(known, albedo / np.float32(scale), np.float32(np.nan))), 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sharper = np.nan_to_num(white / scale / lit(albedo), nan=1.0, posinf=1.0)
    albedo = np.clip(albedo * np.clip(sharper, 1 / SHARPEST, SHARPEST), 0, 1)
    projector = rig.projector.model_copy(update={"radiant_flux_w": rig.projector.radiant_flux_w * scale})
    bright = rig.model_copy(update={"projector": projector})
    beyond = light.dark - _black_dn(bright, camera, exposure) - white * np.float32(per_radiance / rig.projector.contrast)
    share = beyond[known] / (albedo * optics.transmission * np.float32(per_radiance))[known]
    room = max(float(np.nanmedian(share)), 0.0)
    thing = Thing("surface", mesh, Material(EVEN), albedo[v, u])
    return SeenScene(bright, Scene("seen", (thing, _backdrop(mesh))), room * LUMENS_PER_WATT * np.pi * 1e6, inside & known)


def smoothed(points: PointMap, camera: Camera) -> tuple[Image, NDArray[np.bool_]]:
    """Points : (h, w, 3) mm, moved along their rays to a weighted mean of their neighbours; and those beside no step.

    As far as it takes for slopes that noise leaves at some hundredths: light on a rough surface would have shadows.
    """
    away = points.points.astype(float) - camera.centre
    distance = np.linalg.norm(away, axis=-1)
    known = np.isfinite(distance)
    step = np.median(distance[known]) / camera.matrix[0, 0]
    noise = float(np.median(points.sigma[known & np.isfinite(points.sigma)])) / step
    # Slopes of white noise behind a Gaussian of s px: noise / (s^2 sqrt(8 pi))
    width = float(np.clip(np.sqrt(noise / (SLOPE * np.sqrt(8 * np.pi))), LEAST_PX, MOST_PX))
    share = gaussian_filter(known.astype(float), width, mode="constant")
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = gaussian_filter(np.where(known, distance, 0), width, mode="constant") / share
        moved = away * (mean / distance)[..., None] + camera.centre
    moved[~known] = np.nan
    whole = share > 0.99
    steady = np.abs(mean - distance) < SHIFTED * np.maximum(points.sigma, noise * step) + step / 2
    return moved.astype(np.float32), known & whole & np.nan_to_num(steady).astype(bool)


def _backdrop(mesh: trimesh.Trimesh) -> Thing:
    """Black cloth behind a surface, in place of the room's light from there: what else stood there isn't known."""
    middle, farthest = mesh.vertices.mean(axis=0), mesh.vertices[:, 2].max()
    place = rigid.transform(np.eye(3), (middle[0], middle[1], farthest + BEHIND_MM))
    cloth = solid_meshes.moved(solid_meshes.plate((CLOTH_MM, CLOTH_MM), 1.0), place)
    return Thing("backdrop", cloth, Material(0.0), smooth=False)


def _filled(values: Image) -> Image:
    """Values : (h, w) with means of near ones in place of unknown ones."""
    known = np.isfinite(values)
    near = gaussian_filter(np.where(known, values, 0), MOST_PX) / np.maximum(
        gaussian_filter(known.astype(np.float32), MOST_PX), 1e-6
    )
    return np.where(known, values, near).astype(np.float32)


def _black_dn(rig: Rig, camera: CameraName, exposure: Exposure) -> float:
    """Mean of a pixel without light, DN: the black level and the dark current, less what the ADC's dropped bits take."""
    sensor = getattr(rig, camera).sensor
    dropped = 0.5 - 0.5 ** (sensor.adc_bits - exposure.bits + 1)
    dark = sensor.dark_current_e_per_s * exposure.time_s * number_per_electron(sensor, exposure)
    return sensor.black_level_dn * 2.0 ** (exposure.bits - 8) + dark - dropped
