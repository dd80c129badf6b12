"""A capture's surface as a scene: its shape by the fringes, its reflectance by the light that came back.

A pixel's images at places of a projector's image that are far inside of bright and of dark stripes show its light under a white
and under a black image, whatever gamma and blur are. Over the light that the rig would send there, that is the reflectance;
what the dark image has beyond the black level is the room's light. So neither fringes nor edges are used for what they test.

A part of that light came from other places of the surface. It is in dark stripes, too, and grows with the reflectance, which is
found by it, with as many reflections as are traced. On a plane, and with one reflection, images show the product of flux and
reflectance alone, and the flux is set so that bright places have a usual one.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import cv2
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter
from scipy.optimize import minimize_scalar

from recon.capture.surface_part import SurfaceCapture
from recon.errors import InputError
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
KnownBy = Literal["found", "or less", "or more", "assumed"]  # a reflectance: beyond the least or the most that is tried

INSIDE_PX = 4.0  # projector px from an edge, and half a period of the fringes, from which on a place counts as inside a stripe
UNCLIPPED, WINDOW = 0.96, (5, 5)  # of full scale: means of neighbouring px are below where none of them is clipped
FAR_PX = 64.0  # projector px from an edge, from which on farther ones count no more
BRIGHT = 95.0  # percentile of the reflectances, which gets
USUAL = 0.8  # this one, of plaster or paper, but for places that are brighter still:
BRIGHTEST = 99.0  # percentile of the reflectances that is `MOST` at most
EVEN = 0.5  # reflectance of a first render
SHARPEST = 2.0  # factor by which the blur of rendering is undone at most
GAP_PX = 6  # camera px, half the width of gaps that are closed
FEW = 4  # paths a pixel of light between places, which is smoothed
ROUNDS = 2  # of that light and the reflectance
LEAST, MOST = 0.03, 0.95  # reflectance of bright places that light between them may tell
BLOCKS = 8  # of the surface's longer side, and fewest in all; errors of light in the dark go together within one
CLEAR = 5.0  # times its scatter between blocks, of a gain over the least or the most: 10 to 13 in grooves, 3 at most on a sphere
AT_END = 0.01  # share of the least or the most reflectance, within which one counts as that
NEAR = 1e-3  # share of known px around one, by which it is filled
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
    reflectance: float  # of bright places
    known_by: KnownBy  # that reflectance: assumed as usual, where light between places doesn't show it
    inside: NDArray[np.bool_]  # (h, w) pixels whose surroundings are on the surface, and alike on it

    @property
    def reflectance_in_words(self) -> str:
        """That of bright places, and whether it was found."""
        if self.known_by == "assumed":
            return f"reflectance assumed {self.reflectance:.2f}: light between places doesn't show it"
        return f"reflectance {self.reflectance:.2f}{'' if self.known_by == 'found' else f' {self.known_by}'}"


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


def seen_light(images: NDArray, patterns: Patterns, found: ProjectorMap, gamma: float, full: float) -> SeenLight:
    """Light of pixels under a white and a black image, by the images whose stripes they lie inside of.

    Where bright stripes are near `full`, and so clipped, the fringes' mean stands for them, which no blur changes: it is as far
    from dark to bright as elsewhere. Of a sequence without stripes the fringes tell all, by the projector's gamma and without its
    blur.
    """
    shape = images.shape[1:]
    sums, weights = np.zeros((2, *shape), np.float32), np.zeros((2, *shape), np.float32)
    axes = [axis for axis, x in (("columns", found.columns), ("rows", found.rows)) if x is not None]
    for edges in stripes(patterns):
        if edges.axis not in axes:
            continue
        inside = inside_of(edges, found)
        unclipped = cv2.blur(images[edges.number].astype(np.float32), WINDOW) < UNCLIPPED * full
        least = INSIDE_PX if np.isinf(edges.pitch) else max(INSIDE_PX, edges.pitch / 2)
        weight = np.where(np.abs(inside) >= least, np.minimum(np.abs(inside), FAR_PX), 0)
        for k, side in enumerate((inside < 0, (inside > 0) & unclipped)):
            weights[k] += weight * side
            sums[k] += weight * side * images[edges.number]
    if not weights.any():
        return _by_fringes(images, patterns, found, gamma)
    with np.errstate(invalid="ignore"):
        dark, bright = sums / np.where(weights > 0, weights, np.float32(np.nan))
    for part, place in patterns.slices():
        clipped = np.isnan(bright) & np.isfinite(dark)
        if not isinstance(part, Fringes) or not clipped.any() or not np.isfinite(bright).any():
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            beyond = np.where(images[place].max(axis=0) < full, images[place].mean(axis=0, dtype=np.float32) - dark, np.nan)
            bright[clipped] = (dark + beyond / np.nanmedian(beyond / (bright - dark)))[clipped]
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
        If there are pixels that no ray reaches, or none whose light under a white image is known.
    """
    device = getattr(rig, camera)
    points, inside = smoothed(skin.points, device.optics.camera())
    mesh = surface_mesh.mesh(PointMap(points, skin.points.sigma), device.optics.camera())
    u, v = np.rint(device.optics.camera().project(mesh.vertices)).astype(int).T
    light = seen_light(shots.images, shots.patterns, skin.found, rig.projector.gamma, 2.0**shots.bits - 1)
    optics = camera_optics(rig, camera)
    per_radiance = (
        electrons_per_radiance(device, rig.projector.wavelength_nm)
        * exposure.time_s
        * number_per_electron(device.sensor, exposure)
    )
    light = _with_dark(light)
    white = light.bright - light.dark
    projector, straight = ProjectorOptics.of(rig.projector), tracing.model_copy(update={"room_lux": 0.0, "bounces": 1})

    def world_of(albedo: Image) -> mi.Scene:
        """The surface alone."""
        return build_world(Scene("seen", (Thing("surface", mesh, Material(EVEN), albedo[v, u]),)))

    def lit(albedo: Image) -> Image:
        """Light : (h, w) DN under a white image, less that under a black one, straight from the projector."""
        size = rig.projector.optics.size
        all_on = Light.of_profiles(size, [("columns", True, np.ones(size[0], np.float32))], rig.projector)
        shown = render(world_of(albedo), optics, projector, all_on, straight, seed)[0]
        return shown * np.float32((1 - 1 / rig.projector.contrast) * per_radiance)

    def again(albedo: Image) -> list[SeenLight]:
        """Light that comes back from the surface once more, twice more, and so on, DN."""
        world, shown = world_of(albedo), Light.of(shots.patterns, rig.projector)
        few = [straight.model_copy(update={"samples": FEW, "bounces": most + 1}) for most in range(tracing.bounces)]
        sums = [render(world, optics, projector, shown, one, seed) for one in few]  # all of the same paths
        orders = [(longer - shorter) * np.float32(per_radiance) for shorter, longer in pairwise(sums)]
        return [seen_light(images, shots.patterns, skin.found, rig.projector.gamma, np.inf) for images in orders]

    with np.errstate(divide="ignore", invalid="ignore"):
        albedo = EVEN * white / lit(np.full(white.shape, np.float32(EVEN)))
    known = np.isfinite(albedo) & (albedo > 0) & np.isfinite(points[..., 0])
    if not known.any():
        clipped = not np.isfinite(light.bright).any()
        cause = "white is clipped everywhere; record with a shorter exposure" if clipped else "the projector lights none of it"
        raise InputError(f"{shots.name}: expected a surface under white below {UNCLIPPED:.0%} of full scale, found that {cause}")
    usable = known & inside if (known & inside).any() else known  # at borders and steps reflectances are wrong
    scale = max(float(np.percentile(albedo[usable], BRIGHT)) / USUAL, float(np.percentile(albedo[usable], BRIGHTEST)) / MOST)
    albedo = np.clip(_filled(np.where(known, albedo / np.float32(scale), np.float32(np.nan))), 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sharper = np.nan_to_num(white / scale / lit(albedo), nan=1.0, posinf=1.0)
    albedo = np.clip(albedo * np.clip(sharper, 1 / SHARPEST, SHARPEST), 0, 1)
    share, direct = optics.transmission * np.float32(per_radiance), white
    beyond = light.dark - _black_dn(rig, camera, exposure) - white / np.float32(rig.projector.contrast)
    between, known_by = np.float32(0), "assumed"
    for _ in range(ROUNDS if tracing.bounces > 1 else 0):
        orders = [SeenLight(*(_but_for(albedo, np.float32(scale) * side) for side in one)) for one in again(albedo)]
        bright = float(np.percentile(albedo[usable], BRIGHT))
        usual = min(USUAL, MOST / float(np.percentile(albedo[usable], BRIGHTEST)) * bright)
        times, known_by = reflectance_factor(beyond, albedo * share, [one.dark for one in orders], usable, bright, usual)
        more, dark = (sum(times**k * one[side] for k, one in enumerate(orders, 1)) for side in range(2))
        left = np.nan_to_num(white / (direct + more - dark), nan=1.0, posinf=1.0)
        direct, between, scale = direct * left, dark * left, scale / times
        albedo = np.clip(albedo * left * times, 0, 1).astype(np.float32)
    device = rig.projector.model_copy(update={"radiant_flux_w": rig.projector.radiant_flux_w * scale})
    room = max(float(np.nanmedian(((beyond - between) / (albedo * share))[known])), 0.0)
    thing = Thing("surface", mesh, Material(EVEN), albedo[v, u])
    return SeenScene(
        rig.model_copy(update={"projector": device}),
        Scene("seen", (thing, _backdrop(mesh))),
        room * LUMENS_PER_WATT * np.pi * 1e6,
        float(np.percentile(albedo[usable], BRIGHT)),
        known_by,
        inside & known,
    )


def _with_dark(light: SeenLight) -> SeenLight:
    """Light with a share of the bright as around where no image was dark, as under a word of Gray code that is all ones."""
    with np.errstate(invalid="ignore", divide="ignore"):
        share = light.dark / light.bright
    if not np.isfinite(share).any():
        return light
    unknown = np.isnan(light.dark) & np.isfinite(light.bright)
    return light._replace(dark=np.where(unknown, _filled(share) * light.bright, light.dark))


def _but_for(base: Image, light: Image) -> Image:
    """Light : (h, w) that is smooth but for what it has in common with a base, without its noise; NaN where that isn't light."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share, _ = _around(np.where(base > 0, light / base, np.float32(np.nan)), MOST_PX)
    return np.where(base > 0, base * share, np.float32(np.nan))


def reflectance_factor(
    beyond: Image, even: Image, dark: list[Image], known: NDArray[np.bool_], bright: float, usual: float
) -> tuple[float, KnownBy]:
    """Factor of the reflectance by which light between places explains what is in dark stripes, beside an even room's.

    Light that comes back n times goes with its n-th power; the flux goes down as the reflectance goes up. Where that light is too
    little to tell the best reflectance from the least and from the most one, the factor is that of the usual one. It is told
    by blocks of the image, for noise is not all that the light in dark stripes has besides.

    Parameters
    ----------
    bright : reflectance of bright places that goes with a factor of 1
    usual : of bright places, where light between them doesn't tell it
    """
    told = known & np.isfinite(beyond) & np.isfinite(dark).all(axis=0)
    if not told.any():
        return usual / bright, "assumed"

    def unexplained(times: float) -> Array:
        rest = beyond[told] - sum(times**k * one[told] for k, one in enumerate(dark, 1))
        return np.abs(rest - max(np.median(rest / even[told]), 0.0) * even[told])

    least, most = LEAST / bright, MOST / bright
    best = float(minimize_scalar(lambda times: float(unexplained(times).mean()), bounds=(least, most), method="bounded").x)
    place = np.stack(np.nonzero(told))
    place -= place.min(axis=1, keepdims=True)
    row, column = place * BLOCKS // (place.max() + 1)
    block = row * BLOCKS + column
    number = np.bincount(block)

    def clearly_less_than(times: float) -> bool:
        """The best one's cost, by the scatter of the difference between blocks."""
        gain = unexplained(times) - unexplained(best)
        scatter = np.sqrt(np.sum((np.bincount(block, gain) - gain.mean() * number) ** 2))
        return np.count_nonzero(number) >= BLOCKS and bool(gain.sum() > CLEAR * scatter)

    if not clearly_less_than(least) and not clearly_less_than(most):
        return usual / bright, "assumed"
    at_end: list[KnownBy] = [name for name, end in (("or less", least), ("or more", most)) if abs(best / end - 1) < AT_END]
    return best, at_end[0] if at_end else "found"


def smoothed(points: PointMap, camera: Camera) -> tuple[Image, NDArray[np.bool_]]:
    """Points : (h, w, 3) mm, moved along their rays to a weighted mean of their neighbours; and those beside no step.

    As far as it takes for slopes that noise leaves at some hundredths: light on a rough surface would have shadows. Narrow gaps,
    as of creases in the projector's shadow, are closed: light would be lost in them.
    """
    away = points.points.astype(float) - camera.centre
    distance = np.linalg.norm(away, axis=-1)
    known = np.isfinite(distance)
    step = np.median(distance[known]) / camera.matrix[0, 0]
    noise = float(np.median(points.sigma[known & np.isfinite(points.sigma)])) / step
    # Slopes of white noise behind a Gaussian of s px: noise / (s^2 sqrt(8 pi))
    width = float(np.clip(np.sqrt(noise / (SLOPE * np.sqrt(8 * np.pi))), LEAST_PX, MOST_PX))
    mean, share = _around(distance, width)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = away * (mean / distance)[..., None] + camera.centre
    moved[~known] = np.nan
    gaps = binary_closing(known, iterations=GAP_PX) & ~known
    moved[gaps] = camera.centre + camera.pixel_rays()[gaps] * _filled(np.where(known, mean, np.nan))[gaps, None]
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
    """Values : (h, w), some known, with means of near ones in place of unknown ones; farther off the mean at the nearest."""
    near, share = _around(values, MOST_PX)
    row, column = np.asarray(distance_transform_edt(share < NEAR, return_distances=False, return_indices=True))
    return np.where(np.isfinite(values), values, near[row, column]).astype(np.float32)


def _around(values: Image, width: float) -> tuple[Image, Image]:
    """Mean of the known values around each place : (h, w), by a Gaussian of a width in px; and the share of known ones."""
    known = np.isfinite(values)
    share = gaussian_filter(known.astype(values.dtype), width, mode="constant")
    with np.errstate(divide="ignore", invalid="ignore"):
        return gaussian_filter(np.where(known, values, 0), width, mode="constant") / share, share


def _black_dn(rig: Rig, camera: CameraName, exposure: Exposure) -> float:
    """Mean of a pixel without light, DN: the black level and the dark current, less what the ADC's dropped bits take."""
    sensor = getattr(rig, camera).sensor
    dropped = 0.5 - 0.5 ** (sensor.adc_bits - exposure.bits + 1)
    dark = sensor.dark_current_e_per_s * exposure.time_s * number_per_electron(sensor, exposure)
    return sensor.black_level_dn * 2.0 ** (exposure.bits - 8) + dark - dropped
