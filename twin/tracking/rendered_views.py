"""From a sample's parameters to camera images and their ground truth; several takes in one launch."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import MOST_CIRCLES, PROBE, CameraDevice, Rig, Target
from recon.threads import mapped
from twin.sensor import Exposure, digitise, number_per_electron, read_out, readout_by, sensed
from twin.shooting import FilmQuality, Quality
from twin.tracking.film_pictures import (
    CONTRAST,
    FINE_PX,
    FIRST_PX,
    SHADOWS,
    Cells,
    Pixels,
    arriving,
    bends,
    composed,
    contrasts,
    fine_cells,
    lines_of,
    most_rays,
    near_cells,
    resized,
    scene_pixels,
    shares,
    sharp_pixels,
    visible_shares,
)
from twin.tracking.mesh_bank import Bank
from twin.tracking.moving_transport import NO_CIRCLE, Lanes, Light, circle_number, render
from twin.tracking.pixel_selection import HALF, PATCH, VIEW, Picture, Sketch, View, Window, full_frame, joined
from twin.tracking.samples import Take
from twin.tracking.surface_prints import BitGrid
from twin.tracking.target_truth import ViewTruth, board_corners, inside_share, view_truth

Grey = NDArray[np.uint8]
Image = NDArray[np.float32]
Views = tuple[ViewTruth, ViewTruth]
Stills = tuple[Image, Image]  # (h, w) radiance by both cameras

AROUND = 24  # px of a sketch's window about the targets' boards
COARSE_PX = 4  # cells of a scene that a single frame shows
STILL_K = 1 << 29  # number of what a film's takes have in common, beyond those of all takes
DARKEST = 0.15  # of the light that falls on a face at right angles: what an exposure is set by is never less


@dataclass(frozen=True)
class Frames:
    """Images of both cameras, with the truth of each view."""

    views: tuple[Grey, Grey]  # (240, 320), or (h, w) full frames
    truth: Views  # of the probe's target
    others: Mapping[str, Views] = field(default_factory=dict, kw_only=True)  # of further bodies' targets, by name

    @property
    def bodies(self) -> dict[str, Views]:
        """Truth of all bodies by name, the probe's first."""
        return {PROBE: self.truth, **self.others}


@dataclass(frozen=True)
class Sample(Frames):
    """One sample's images: of the views, too."""

    patches: Grey  # (2, n, 120, 120) of all bodies' circles


class Shot(NamedTuple):
    """One camera's part of a take."""

    take: Take
    camera: int  # 0 or 1
    truth: Mapping[str, ViewTruth]  # by bodies' names

    @property
    def device(self) -> CameraDevice:
        """The camera."""
        return self.take.cameras[self.camera]

    @property
    def late(self) -> float:
        """Share of the exposure by which it exposes later."""
        return self.take.late[self.camera]


def shots_of(takes: Sequence[Take], targets: Mapping[str, Target]) -> list[Shot]:
    """Shots of both cameras of each take, with the truth that needs no rendering."""
    return [
        Shot(take, k, {name: view_truth(held, device, take.late[k], targets[name]) for name, held in take.held.items()})
        for take in takes
        for k, device in enumerate(take.cameras)
    ]


def render_views(bank: Bank, rig: Rig, takes: Sequence[Take], quality: Quality, seed: int) -> list[Sample]:
    """Views at the detector's size, and full-resolution patches."""
    pictures = [[View(device.optics.size, quality.view) for device in take.cameras] for take in takes]
    return _rendered(bank, rig, takes, pictures, quality, seed)


def render_full(
    bank: Bank, rig: Rig, takes: Sequence[Take], quality: Quality, seed: int, grid: BitGrid | None = None
) -> list[Sample]:
    """Full camera images."""
    pictures = [[full_frame(device.optics.size, quality.window) for device in take.cameras] for take in takes]
    return _rendered(bank, rig, takes, pictures, quality, seed, grid)


def render_sketches(
    bank: Bank, rig: Rig, takes: Sequence[Take], quality: Quality, seed: int, grid: BitGrid | None = None
) -> list[Sample]:
    """Full camera images of which the view and a window about the targets are rendered; see `pictures.Sketch`."""
    pictures = [
        [_sketch(take, *seen, rig.targets, quality) for seen in zip(take.cameras, take.late, strict=True)] for take in takes
    ]
    return _rendered(bank, rig, takes, pictures, quality, seed, grid)


def render_film(
    bank: Bank, rig: Rig, takes: Sequence[Take], quality: FilmQuality, seed: int, still: Stills | None = None
) -> list[Frames]:
    """Full camera images of which some pixels are rendered and the others interpolated; see `film_pictures`.

    still : the scene of all takes, as of `render_still`; without, each has its own, in cells of some pixels
    """
    shots, most = shots_of(takes, rig.targets), most_rays(quality)
    scenes = list(still * len(takes)) if still else _coarse(bank, rig, shots, quality, seed)
    whites = [white_radiance(shot.take, rig) for shot in shots]
    lines = [lines_of(shot.take.held, shot.device, shot.late) for shot in shots]

    def traced(selections: Iterable[Cells | Pixels], shadows: int = 0) -> list[Light]:
        return _traced(bank, rig, shots, selections, most, seed, shadows)

    first = [Cells.all_over(shot.device.optics.size, FIRST_PX, quality.view) for shot in shots]
    found = traced(first, SHADOWS)
    near = list(mapped(near_cells, first, found, scenes, whites, lines, [quality] * len(shots)))
    light = traced(near, SHADOWS)
    fine = list(mapped(fine_cells, near, light, lines, [quality] * len(shots)))
    bodies = traced(fine)

    def sharpened(shot: Shot, cells: Cells, its: Light, white: float, thin: Sequence[NDArray[np.float64]]) -> Pixels:
        contrast = (bends(cells.spread(its.held_plain)) > CONTRAST * white) | (contrasts(cells.spread(its.held)) > 0)
        targets = [rig.targets[name] for name in shot.truth]
        return sharp_pixels(contrast, cells.size, thin, list(shot.truth.values()), targets, quality)

    sharp = list(mapped(sharpened, shots, fine, bodies, whites, lines))
    sharply = traced(sharp)

    def finished(shot: Shot, number: int) -> tuple[Grey, dict[str, ViewTruth]]:
        pixels, its, scene = sharp[number], sharply[number], scenes[number]
        share = shares(first[number], found[number], near[number], light[number])
        visible = visible_shares(pixels, its, len(shot.truth) * MOST_CIRCLES)
        truth = {}
        for body, (name, known) in enumerate(shot.truth.items()):
            circles = slice(circle_number(body, 0), circle_number(body, len(known.ellipses)))
            seen = visible[circles] * inside_share(known.ellipses, shot.device.optics.size)
            own = (pixels.circle // MOST_CIRCLES == body) | ((pixels.circle == NO_CIRCLE) & (body == 0))
            arrived = its.white_radiance * share.held[pixels.v, pixels.u]
            white = _white(float(its.white[own].sum()), float(arrived[own].sum()), shot.take, shot.device, rig)
            truth[name] = replace(known, visible=seen, white_dn=white)
        return _exposed(composed(fine[number], bodies[number], share, pixels, its, scene), shot, rig), truth

    both = list(mapped(finished, shots, range(len(shots))))
    result = []
    for (first_view, known), (second_view, others) in zip(both[::2], both[1::2], strict=True):
        truth, those = _paired(known, others)
        result.append(Frames((first_view, second_view), truth, others=those))
    return result


def render_still(bank: Bank, rig: Rig, take: Take, quality: FilmQuality, seed: int) -> Stills:
    """The scene without bodies by both cameras : (h, w) radiance each, of each pixel, with more rays at outlines."""
    shots, white, most = shots_of([_empty(take, STILL_K)], rig.targets), white_radiance(take, rig), most_rays(quality)
    cells = [Cells.all_over(shot.device.optics.size, FINE_PX, quality.view) for shot in shots]
    light = _traced(bank, rig, shots, cells, most, seed, SHADOWS)
    plain = [one.spread(its.plain) for one, its in zip(cells, light, strict=True)]
    share = [arriving(one.spread(its.radiance), its_plain) for one, its, its_plain in zip(cells, light, plain, strict=True)]
    pixels = [scene_pixels(its_plain, white, one.size, quality) for one, its_plain in zip(cells, plain, strict=True)]
    plain = [resized(its_plain, one.size) for one, its_plain in zip(cells, plain, strict=True)]
    for image, some, its in zip(plain, pixels, _traced(bank, rig, shots, pixels, most, seed, 0), strict=True):
        image[some.v, some.u] = its.plain
    first, second = (image * resized(its, one.size) for image, its, one in zip(plain, share, cells, strict=True))
    return first, second


def _coarse(bank: Bank, rig: Rig, shots: Sequence[Shot], quality: FilmQuality, seed: int) -> list[Image]:
    """The scene of each shot without bodies : (h, w) radiance."""
    cells = [Cells.all_over(shot.device.optics.size, COARSE_PX, quality.view) for shot in shots]
    empty = [shot._replace(take=_empty(shot.take, shot.take.k)) for shot in shots]
    found = _traced(bank, rig, empty, cells, most_rays(quality), seed, SHADOWS)
    plain = [(one, one.spread(light.plain), one.spread(light.radiance)) for one, light in zip(cells, found, strict=True)]
    return [resized(its * arriving(radiance, its), one.size) for one, its, radiance in plain]


def _empty(take: Take, k: int) -> Take:
    """The take without its bodies, by the sample points of another."""
    return replace(take, k=k, present=False, others={name: replace(held, present=False) for name, held in take.others.items()})


def _traced(
    bank: Bank, rig: Rig, shots: Sequence[Shot], selections: Iterable[Cells | Pixels], most: int, seed: int, shadows: int
) -> list[Light]:
    """Light of the pixels of each shot, in one launch; of takes one by one, as of several, for one kernel would be another."""
    blocks = [one.lanes(number, shot.camera) for number, (one, shot) in enumerate(zip(selections, shots, strict=True))]
    light = render(bank, rig, [shot.take for shot in shots], joined(blocks), most, seed, shadows=shadows)
    return [light.part(slice(a, b)) for a, b in pairwise(np.cumsum([0, *(len(block.u) for block in blocks)]))]


def _paired(first: Mapping[str, ViewTruth], second: Mapping[str, ViewTruth]) -> tuple[Views, dict[str, Views]]:
    """Truth of both views, of the probe's target and of further bodies'."""
    both = {name: (first[name], second[name]) for name in first}
    return both.pop(PROBE), both


def _exposed(radiance: Image, shot: Shot, rig: Rig) -> Grey:
    """Digital numbers of a whole image : (h, w)."""
    sensor, exposure = shot.device.sensor, Exposure(1.0, shot.take.gain)
    response, offset = (part.reshape(radiance.shape) for part in _unit_pattern(*radiance.shape, shot.device.serial))
    pattern = 1 + np.float32(sensor.prnu) * response, np.float32(sensor.dsnu_e) * offset
    readout = readout_by(sensor, exposure, _electrons(shot.take, shot.device, rig))
    return sensed(radiance, pattern, readout, sensor, exposure, np.random.default_rng([shot.take.noise_seed, shot.camera, 1]))


def _sketch(take: Take, device: CameraDevice, late: float, targets: Mapping[str, Target], quality: Quality) -> Sketch:
    size, camera = device.optics.size, device.optics.camera()
    first, extent = (0, 0), (1, 1)
    ways = [(held.motion.later(late), board_corners(targets[name])) for name, held in take.held.items() if held.present]
    if ways:
        places = np.concatenate([camera.project(rigid.apply(way.at(t), corners)) for way, corners in ways for t in (-0.5, 0.5)])
        if np.isfinite(places).all():
            low = np.clip(np.floor(places.min(axis=0)) - AROUND, 0, np.array(size) - 2).astype(int)
            high = np.clip(np.ceil(places.max(axis=0)) + AROUND, low + 1, np.array(size) - 1).astype(int)
            first, extent = tuple(low.tolist()), tuple((high - low + 1).tolist())
    return Sketch(View(size, quality.view), Window(size, first, extent, quality.window, sets=3))


def _rendered(
    bank: Bank,
    rig: Rig,
    takes: Sequence[Take],
    pictures: Sequence[Sequence[Picture]],
    quality: Quality,
    seed: int,
    grid: BitGrid | None = None,
) -> list[Sample]:
    """One launch for all images and patches of all takes; then the sensors, image by image."""
    targets = rig.targets
    counts = [circle_layout.count(targets[name]) for name in takes[0].held]
    count = sum(counts)
    shots = shots_of(takes, targets)
    blocks, origins = [], []
    for shot, picture in zip(shots, (one for both in pictures for one in both), strict=True):
        firsts = [_patch_origins(shot, number, truth) for number, truth in enumerate(shot.truth.values())]
        patches = [
            Window(shot.device.optics.size, tuple(first.tolist()), (PATCH, PATCH), quality.patch, circle, circle)
            for number, those in enumerate(firsts)
            for circle, first in enumerate(those, circle_number(number, 0))
        ]
        blocks += [one.lanes(len(origins) // 2, shot.camera) for one in (picture, *patches)]
        origins.append(firsts)
    light = render(bank, rig, takes, joined(blocks), max(4 * quality.view, quality.patch, quality.window), seed, grid)
    starts = np.cumsum([0, *(len(block.u) for block in blocks)])
    pieces = [slice(a, b) for a, b in pairwise(starts)]
    numbers = _sensed(takes, rig, blocks, [light.radiance[piece] for piece in pieces])
    result = []
    for i, take in enumerate(takes):
        views, patches, told = [], [], []
        for camera, device in enumerate(take.cameras):
            shot = shots[2 * i + camera]
            at = (1 + count) * (2 * i + camera)  # an image and a patch each circle
            views.append(pictures[i][camera].image(numbers[at]))
            patches.append(np.stack(numbers[at + 1 : at + 1 + count]).reshape(count, PATCH, PATCH))
            seen, known = iter(pieces[at + 1 : at + 1 + count]), {}
            for (name, truth), those in zip(shot.truth.items(), origins[2 * i + camera], strict=True):
                its = list(islice(seen, len(those)))
                rays, arrived = (sum(float(part[piece].sum()) for piece in its) for part in (light.white, light.white_radiance))
                known[name] = replace(
                    truth,
                    visible=_visible(light, its) * inside_share(truth.ellipses, device.optics.size),
                    white_dn=_white(rays, arrived, take, device, rig),
                    patch_origins=those,
                )
            told.append(known)
        truth, others = _paired(*told)
        result.append(Sample((views[0], views[1]), truth, np.stack(patches), others=others))
    return result


def _patch_origins(shot: Shot, number: int, truth: ViewTruth) -> NDArray[np.int64]:
    """Where patches begin : (n, 2) px, about the circles as a detector that is a pixel off would place them; or anywhere."""
    rng = np.random.default_rng([shot.take.noise_seed, shot.camera, *([1 + number] if number else [])])
    size = np.array(shot.device.optics.size)
    coarse = np.rint(np.nan_to_num(truth.centres) / (size / VIEW) + rng.uniform(-1, 1, truth.centres.shape)) * (size / VIEW)
    if not np.isfinite(truth.centres).all():
        coarse = rng.uniform([0, 0], size, truth.centres.shape)
    return np.rint(np.clip(coarse, 0, size - 1)).astype(int) - HALF


def _sensed(takes: Sequence[Take], rig: Rig, blocks: Sequence[Lanes], radiance: Sequence[NDArray[np.float32]]) -> list[Grey]:
    """Digital numbers from radiance, block by block; each block belongs to one camera of one take."""
    streams = {
        (i, camera): np.random.default_rng([take.noise_seed, camera, 1]) for i, take in enumerate(takes) for camera in (0, 1)
    }
    numbers = []
    for block, light in zip(blocks, radiance, strict=True):
        i, camera = int(block.take[0]), int(block.camera[0])
        device = takes[i].cameras[camera]
        pixel = block.v.astype(int) * device.optics.size[0] + block.u.astype(int)
        numbers.append(_read(light * _electrons(takes[i], device, rig), pixel, device, takes[i], streams[i, camera]))
    return numbers


def _electrons(take: Take, device: CameraDevice, rig: Rig) -> float:
    """Electrons for a radiance of 1, so that the target's white comes to the number that the exposure aims at."""
    return take.white_dn / number_per_electron(device.sensor, Exposure(1.0, take.gain)) / white_radiance(take, rig)


def white_radiance(take: Take, rig: Rig) -> float:
    """Radiance of the target's white in the middle, nothing in the way."""
    pose, lighting = take.motion.world_from_target, take.lighting
    place = pose[:3, 3] + pose[:3, :3] @ circle_layout.middle(rig.target)
    ways = np.vstack([lighting.lamps[:, :3], rig.projector.optics.camera().centre]) - place
    distance2 = (ways**2).sum(axis=1)
    cosine = np.maximum(ways @ pose[:3, 2] / np.sqrt(distance2), DARKEST)
    intensity = np.append(lighting.lamps[:, 4], lighting.projector[0] * lighting.projector[1])
    around = np.pi * lighting.ambient * (1 + 2 / 3 * (lighting.gradient @ pose[:3, 2]))
    return float(take.face.paper / np.pi * ((intensity * cosine / distance2).sum() + around))


def _read(electrons, pixel: NDArray[np.int64], device: CameraDevice, take: Take, rng: np.random.Generator) -> Grey:
    """Digital numbers of pixels, counted row by row, from mean numbers of electrons."""
    sensor = device.sensor
    width, height = device.optics.size
    response, offset = _unit_pattern(height, width, device.serial)
    mean = electrons * (1 + np.float32(sensor.prnu) * response[pixel])
    mean = np.float32(np.clip(mean, 0, 20 * sensor.saturation_e))
    read = read_out(mean[None], sensor.dark_noise_e, rng)[0] + np.float32(sensor.dsnu_e) * offset[pixel]
    return digitise(read, sensor, Exposure(1.0, take.gain))


@lru_cache(maxsize=4)
def _unit_pattern(height: int, width: int, serial: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A sensor's fixed pattern with all deviations 1 : response and offset (height * width,)."""
    rng = np.random.default_rng(serial)
    return rng.standard_normal(height * width, np.float32), rng.standard_normal(height * width, np.float32)


def _visible(light: Light, pieces) -> NDArray[np.float64]:
    """Uncovered share of each disc's area within the image : (n,)."""
    return np.array([light.seen[piece].sum() / max(light.disc[piece].sum(), 1) for piece in pieces], float)


def _white(rays: float, radiance: float, take: Take, device: CameraDevice, rig: Rig) -> float:
    """Brightness of the target's white about the circles, in digital numbers above black, from the sum of the radiance of rays
    that end there; NaN without any.
    """
    if rays == 0:
        return float("nan")
    return radiance / rays * _electrons(take, device, rig) * number_per_electron(device.sensor, Exposure(1.0, take.gain))
