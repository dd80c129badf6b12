"""Masses darker or brighter than the tissue around them, in tracked B-scans: each a closed surface in the world."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from recon import arguments, threads
from recon.errors import InputError
from recon.freehand.volume_compounding import Clip, Grid, grid_of
from recon.geometry import rigid
from recon.segmentation import blur_correction, border_fit, echo_power, gel, mass_network
from recon.segmentation.blur_correction import Blur, Planes
from recon.segmentation.echo_power import EchoPower, pixel_mm
from recon.segmentation.left_out import LeftOut, Reason
from recon.segmentation.mass_network import Looks, Network
from recon.segmentation.mass_surface import Mass, distances, evened, parted
from recon.segmentation.refraction import Sound, follow
from recon.segmentation.rough_bodies import FAINT, LIMITS, LOOK, Found, Rough, faint, in_words, likely, rough, say
from recon.segmentation.shadow_clearing import Recording, cleared, passed

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SPACING_MM = (0.5, 0.25, 0.5)  # along the array, the beam and across; a border square to the beam is a line of its pulse
REFINEMENTS = (2, 3)  # after each clearing
LOOK_WAYS: dict[Reason, str] = {
    "looks like tissue": "it looks like tissue, such as a lobule of fat",
    "unsure": "it may be a mass, or tissue that looks like one",
}


def from_scans(
    images: Callable[[], Iterator[NDArray]],
    shape: tuple[int, int],
    world_from_pixel: Array,
    sound: Sound | None = None,
    dynamic_range_db: float = 60.0,
    grey: float | None = None,
    blur: Blur | None = None,
    looks: Looks | None = None,
) -> Found:
    """Find masses in B-scans, largest first, and what is left out.

    Parameters
    ----------
    images : streams the n B-scans (h, w) uint8, one by one, from the first at each call
    shape : (h, w)
    world_from_pixel : (n, 4, 4)
        With depths as of the tissue's speed of sound, see `recon.probe_calibration.sound_in_water.in_tissue`; images with a NaN
        are left out.
    grey : float
        Of tissue, by default that of `tissue_grey`.
    blur : of the B-scans
        Lobes of masses are corrected for it, and for what the fit does to them; edges of shadows are as wide as the beam. Without
        it neither is done.
    looks : whether, and by which network, masses are told from grown tissue

    Raises
    ------
    InputError
        If no image has a pose, they show no tissue, or `shape` isn't theirs.
    """
    if not callable(images):
        expected = "a function that gives the B-scans from the first on, such as lambda: iter(scans)"
        raise InputError(f"images: expected {expected}, found {arguments.described(images)}")
    arguments.of_kind("sound", sound, Sound, type(None))
    arguments.of_kind("blur", blur, Blur, type(None))
    arguments.of_kind("looks", looks, Looks, type(None))
    height, width = arguments.image_size("shape", shape, "height and width")
    shape = height, width
    world_from_pixel = arguments.places_of_pixels("world_from_pixel", world_from_pixel)
    sound = sound or Sound()
    first = next(images(), None)
    if first is not None and np.shape(first) != shape:
        found = f"images of shape {np.shape(first)}"
        raise InputError(f"shape: expected that of the images, height and width, found {shape} with {found}: swapped?")
    clip = _below_face(shape, world_from_pixel)
    grey = tissue_grey(images(), shape, world_from_pixel) if grey is None else grey
    grid = echo_power.beam_grid(world_from_pixel, shape, SPACING_MM, clip)
    spread_mm = blur.lateral_mm if blur else 0.0
    table = echo_power.powers(grey, dynamic_range_db)
    brightening = gel.brightening(images, world_from_pixel, table, clip.v)
    recording = Recording(images, world_from_pixel, table, clip, spread_mm, brightening)
    power = echo_power.averaged(images(), world_from_pixel, grid, grey, dynamic_range_db, clip, brightening)
    roughly = 1  # refinement of the surface, as exact as clearing needs it
    with_shadows = power
    begun = rough(power)
    even = begun.uneven_db < FAINT.even_db
    looks = looks or Looks()
    if looks.sees(begun.uneven_db):
        return _by_looks(recording, begun, power, sound, looks.network)
    bright = faint(power, [], begun, signs=(1,)).masses if even else []
    masses, left_out = refined([*begun.masses, *bright], power, roughly), list[LeftOut]()
    for times in REFINEMENTS:
        if masses:
            power = cleared(recording, grid, masses, sound)
            masses, shadows = _without_shadows(masses, power, with_shadows)
            masses, left_out = refined(masses, power, times), left_out + shadows
    more = faint(power, masses, begun) if even else Found([], [])
    left_out += more.left_out
    if more.masses:
        power = cleared(recording, grid, [*masses, *refined(more.masses, power, REFINEMENTS[0])], sound)
        masses, shadows = _without_shadows(masses, power, with_shadows)
        left_out += shadows
        masses += refined(more.masses, power, sum(REFINEMENTS))
    masses, hidden = _with_backs(recording, grid, masses, power, with_shadows, sound)
    left_out += hidden
    kept, weak = list[Mass](), list[Mass]()
    for mass in masses:
        others = [other for other in masses if other is not mass]
        if any(_hides(*pair, power) for other in others for pair in ((mass, other), (other, mass))):
            left_out.append(_left_out("weak contrast", mass, power, "it may be the shadow of another, or that one its"))
        elif even and not all(_stands_out(mass, field) for field in ((power, with_shadows) if mass.bright else (power,))):
            left_out.append(_left_out("weak contrast", mass, power, "it hardly differs from the tissue around"))
            weak.append(mass)
        else:
            kept.append(mass)
    casting = [*weak, *(mass for mass in kept if mass.bright)]  # shadows of their borders that clearing leaves
    masses = [
        mass for mass in kept if mass.bright or not any(_behind(mass, one, power, LIMITS.edge_shadow_mm) for one in casting)
    ]
    why = "it may be the shadow of the border of one before it, which is bright or hardly seen"
    left_out += [_left_out("in the shadow of a mass", mass, power, why) for mass in kept if mass not in masses]
    if masses and blur is not None:
        planes = Planes(world_from_pixel, range(clip.v, shape[0]), shape[1], blur)
        masses = blur_correction.corrected(masses, power, planes, partial(refined, times=REFINEMENTS[-1]))
    masses = [part for mass in masses for part in parted(mass, power.volume.directions)]
    left_out = begun.left_out + left_out
    say(left_out)
    return Found(sorted(masses, key=lambda mass: -mass.volume), left_out, begun.uneven_db)


def _by_looks(recording: Recording, begun: Rough, power: EchoPower, sound: Sound, network: Network | None) -> Found:
    """Masses in grown tissue, which is as uneven as they are: by their looks, with borders fitted to the power."""
    grid = grid_of(power.volume)
    chance = mass_network.averaged(recording.images(), recording.world_from_pixel, grid, recording.clip, network)
    found = likely(chance, power, begun)
    masses, left_out = found.masses, found.left_out
    axes = power.volume.directions
    named = [*(mass.centre for mass in masses), *(np.array(one.centre_mm) for one in left_out if one.reason != "gap")]
    inner = LIMITS.core / 2 * np.stack(np.meshgrid(*3 * ((-1, 0, 1),)), axis=-1).reshape(-1, 3)  # of a body's extents
    for dark in (*(_left_out("unsure", one, power, "") for one in begun.masses), *begun.left_out):
        centre, extents = np.array(dark.centre_mm), np.array(dark.extents_mm)
        if dark.reason == "gap" or any((np.abs((other - centre) @ axes) < extents / 2).all() for other in named):
            continue
        share = float(np.mean(np.nan_to_num(_sampled(chance, centre + inner * extents @ axes.T))))
        reason: Reason = "looks like tissue" if share < LOOK.denied else "unsure"
        text = f"a dark body of {dark.volume_mm3:.0f} mm3 at {in_words(dark.centre_mm)} mm is left out: {LOOK_WAYS[reason]}"
        left_out.append(dark.model_copy(update={"reason": reason, "text": text}))
    with_shadows = power
    for times in REFINEMENTS:
        if masses:
            power = cleared(recording, grid, masses, sound)
            masses = refined(masses, power, times)
    masses, hidden = _with_backs(recording, grid, masses, power, with_shadows, sound)
    left_out += hidden
    kept = [part for mass in masses for part in parted(mass, power.volume.directions)]
    say(left_out)
    return Found(sorted(kept, key=lambda mass: -mass.volume), left_out, begun.uneven_db)


def _below_face(shape: tuple[int, int], world_from_pixel: Array) -> Clip:
    """The part of images (h, w) below the ringing at the face; InputError if there is none."""
    top_mm = 3.0  # ringing at the face, left out
    top = int(np.ceil(top_mm / pixel_mm(world_from_pixel)[1]))
    if top >= shape[0] // 2:
        raise InputError(
            f"images: expected more than {2 * top_mm:g} mm of depth, found {shape[0]} rows, of which {top} are ringing"
        )
    return Clip(0, top, shape[1], shape[0])


def tissue_grey(images: Iterable[NDArray], shape: tuple[int, int], world_from_pixel: Array) -> float:
    """Typical grey level of tissue in n B-scans (h, w) uint8: the median of the upper halves of some of those with a pose.

    Raises
    ------
    InputError
        If these are black: gel, a standoff, or water.
    """
    top, placed = _below_face(shape, world_from_pixel).v, np.flatnonzero(np.isfinite(world_from_pixel).all(axis=(1, 2)))
    sampled = 40  # images for the level of tissue
    chosen = set(placed[:: max(1, len(placed) // sampled)].tolist())
    sample = np.stack([image[top : shape[0] // 2] for k, image in enumerate(images) if k in chosen])
    grey = echo_power.typical_grey(sample, slice(None))
    least_grey = 5.0  # of 255, of tissue
    if grey < least_grey:
        expected = f"tissue in the upper half of the B-scans, of a grey level of {least_grey:g} or more"
        raise InputError(f"images: expected {expected}, found {grey:.0f} (median): gel, a standoff, or water?")
    return grey


def _without_shadows(masses: Sequence[Mass], power: EchoPower, with_shadows: EchoPower) -> tuple[list[Mass], list[LeftOut]]:
    """Masses but for dark ones that, in power without the shadows of others, aren't dark or are hardly seen; and these."""
    kept, left_out = list[Mass](), list[LeftOut]()
    for mass in masses:
        values = _sampled(power, _core(mass))
        seen, scanned = np.isfinite(values), np.isfinite(_sampled(with_shadows, _core(mass)))
        if mass.bright:
            kept.append(mass)
        elif seen.mean() <= LIMITS.least_seen * scanned.mean():  # B-scans far apart pass by most of a mass anyway
            why = "too little sound comes there through masses before it"
            left_out.append(_left_out("in the shadow of a mass", mass, power, why))
        elif np.median(values[seen]) >= LIMITS.still:
            why = "it isn't dark without the shadows of masses before it"
            left_out.append(_left_out("shadow of a mass", mass, power, why))
        else:
            kept.append(mass)
    return kept, left_out


def _stands_out(mass: Mass, power: EchoPower) -> bool:
    """Whether a mass differs from the tissue on all its sides that are seen, by half of what it does as a whole."""
    beside_mm, least = (1.0, 1.5, 2.0, 2.5), 20  # of its border; samples of a side
    vertices, away = np.asarray(mass.mesh.vertices), np.asarray(mass.mesh.vertex_normals)
    outside, inside = (np.array([_sampled(power, vertices + side * mm * away) for mm in beside_mm]) for side in (1, -1))
    sides = (away @ power.volume.directions > 0) @ [1, 2, 4]  # octants
    steps = list[float]()
    for chosen in (sides >= 0, *(sides == k for k in range(8))):
        pairs = [values[:, chosen][np.isfinite(values[:, chosen])] for values in (outside, inside)]
        if min(map(len, pairs)) >= least:
            steps.append(float(pairs[0].mean() - pairs[1].mean()))
    if len(steps) < 2:
        return False
    whole, *each = steps
    return (whole < 0) == mass.bright and min(step / whole for step in each) > 0.5


def _with_backs(
    recording: Recording, grid: Grid, masses: Sequence[Mass], power: EchoPower, with_shadows: EchoPower, sound: Sound
) -> tuple[list[Mass], list[LeftOut]]:
    """Masses but for those whose backs aren't told from their shadows, and those behind such; and these."""
    why = [_no_back(recording, grid, masses, number, sound, with_shadows) for number in range(len(masses))]
    backless = [mass for mass, reason in zip(masses, why, strict=True) if reason]
    kept, left_out = list[Mass](), list[LeftOut]()
    for mass, reason in zip(masses, why, strict=True):
        if reason:
            left_out.append(_left_out("its shadow hides its back", mass, power, reason))
        elif any(_behind(mass, one, power) for one in backless):
            reason = "it may be the back or the shadow of one whose back isn't seen, or a mass behind it"
            left_out.append(_left_out("in the shadow of a mass", mass, power, reason))
        else:
            kept.append(mass)
    return kept, left_out


def _no_back(recording: Recording, grid: Grid, masses: Sequence[Mass], number: int, sound: Sound, power: EchoPower) -> str:
    """Why the back of one of the masses isn't told from its shadow, in power with shadows; empty where it is.

    A mass that absorbs much may be as dark before its back as the tissue, if it is bright; a dark one's shadow as dark as itself.
    """
    mass = masses[number]
    if mass.bright:
        if _fades(mass, power):
            return "it fades towards its back, which isn't seen"
    elif any(_brightens(part, power) for part in parted(mass, power.volume.directions)):
        return "it grows brighter towards its back, which isn't told from its shadow"
    own, through = 0.0 if mass.bright else _own(mass, power), passed(recording, grid, masses, number, sound)
    if np.isinf(through):
        return "no tissue is seen behind it, so its back isn't told from its shadow's end"
    if through < LIMITS.passed + LIMITS.own * own:
        return "it is dark behind it, so its back isn't seen"
    wide, deep, long = np.ptp(np.asarray(mass.mesh.vertices) @ power.volume.directions, axis=0).tolist()
    if not mass.bright and through < LIMITS.shadowing and deep > LIMITS.tall * max(wide, long) and deep > LIMITS.tall_mm:
        return f"it is {deep:.0f} mm deep, {max(wide, long):.0f} mm wide at most, and has a shadow, which may hang on to it"
    return ""


def _own(mass: Mass, power: EchoPower) -> float:
    """Median power in a mass's middle; 0 where none is seen."""
    core = _sampled(power, _core(mass))
    return float(np.nanmedian(core)) if np.isfinite(core).any() else 0.0


def _brightens(mass: Mass, power: EchoPower) -> bool:
    """Whether a dark mass ends before its back, in power with shadows: then its shadow, a little brighter, hangs on to it."""
    inside_mm = -6.0, -5.0, -4.0  # of the back: beyond the blur of its border, and its lobes
    deep_mm = float(np.ptp(np.asarray(mass.mesh.vertices) @ power.volume.directions[:, 1]))
    if deep_mm <= -2 * min(inside_mm):
        return False  # too small to tell
    return bool(_about_back(mass, power, inside_mm).mean() > LIMITS.within * max(_own(mass, power), LIMITS.clutter))


def _fades(mass: Mass, power: EchoPower) -> bool:
    """Whether a bright mass fades into its own shadow instead of ending at a border, in power with shadows.

    A body that absorbs more than the tissue may be as dark as that before its back. There the power goes on falling as it did
    within, where behind a border it falls at once and then no more.
    """
    inside_mm, behind_mm, far_mm = -1.0, 2.0, 6.0  # of the border, down the beam
    most, least = 0.3, 0.3  # slope behind over that across; nepers behind: tissue's own loss and a back's speckle make less
    inside, behind, far = np.log(np.maximum(_about_back(mass, power, [inside_mm, behind_mm, far_mm]), 1e-6))
    across, on = (inside - behind) / (behind_mm - inside_mm), (behind - far) / (far_mm - behind_mm)
    return bool(behind - far > least and on > most * max(across, 0.0))


def _about_back(mass: Mass, power: EchoPower, deeper_mm: Sequence[float]) -> Array:
    """Mean power some way down the beam from the middle of a mass's back, off its sides' own shadows; NaN where none is seen."""
    array, beam, aslant = power.volume.directions.T
    vertices, normals = np.asarray(mass.mesh.vertices), np.asarray(mass.mesh.vertex_normals)
    aside = (vertices - mass.centre) @ np.column_stack([array, aslant])
    middle = ((aside / np.abs(aside).max(axis=0)) ** 2).sum(axis=1) < LIMITS.core**2
    back = vertices[middle & (normals @ beam > 0.5)]
    levels = (_sampled(power, back + mm * beam) for mm in deeper_mm)
    return np.array([np.nanmean(level) if np.isfinite(level).any() else np.nan for level in levels])


def _behind(mass: Mass, other: Mass, power: EchoPower, beside_mm: float = 0.0) -> bool:
    """Whether a mass's middle lies behind another, seen along the beam, or by no more than that beside what lies behind it."""
    array, beam, across = ((mass.centre - other.centre) @ power.volume.directions).tolist()
    wide, _, long = np.abs((np.asarray(other.mesh.vertices) - other.centre) @ power.volume.directions).max(axis=0).tolist()
    return beam > 0 and abs(array) < wide + beside_mm and abs(across) < long + beside_mm


def _hides(mass: Mass, other: Mass, power: EchoPower) -> bool:
    """Whether a dark mass begins close behind another of weak contrast, so that it may be its shadow."""
    array, beam, across = power.volume.directions.T
    near_mm, away = 4.0, other.centre - mass.centre
    own, its = (np.asarray(one.mesh.vertices) - one.centre for one in (mass, other))
    gap = float(away @ beam + (its @ beam).min() - (own @ beam).max())
    aside, size = (np.abs(one @ np.column_stack([array, across])) for one in (away, own))
    if mass.bright or other.bright or away @ beam <= 0 or gap >= near_mm or (aside >= size.max(axis=0)).any():
        return False
    return _own(mass, power) > LIMITS.seed


def _core(mass: Mass) -> Array:
    """Places : (n, 3) mm in a mass's middle."""
    return mass.centre + LIMITS.core * (np.asarray(mass.mesh.vertices) - mass.centre)


def _sampled(power: EchoPower, places: Array) -> Array:
    """Power : (n,) at places : (n, 3); NaN where nothing is seen."""
    voxel = np.rint(rigid.apply(np.linalg.inv(power.volume.world_from_voxel), places)).astype(int)
    size = np.array(power.weight.shape[::-1])
    i, j, k = np.clip(voxel, 0, size - 1).T
    there = (power.weight[k, j, i] > 0) & ((voxel >= 0) & (voxel < size)).all(axis=1)
    return np.where(there, power.volume.voxels[k, j, i], np.nan)


def _left_out(reason: Reason, mass: Mass, power: EchoPower, why: str) -> LeftOut:
    """What is told of a mass that is left out."""
    (x, y, z), kind = mass.centre.tolist(), "bright" if mass.bright else "dark"
    along, down, across = np.ptp(np.asarray(mass.mesh.vertices) @ power.volume.directions, axis=0).tolist()
    text = f"a {kind} body of {mass.volume:.0f} mm3 at {x:.0f}, {y:.0f}, {z:.0f} mm is left out: {why}"
    extents = (along, down, across)
    return LeftOut(reason=reason, volume_mm3=mass.volume, centre_mm=(x, y, z), extents_mm=extents, text=text)


def shown(masses: Sequence[Mass], world_from_pixel: Array, shape: tuple[int, int], sound: Sound) -> Iterator[Mask]:
    """Pixels of each B-scan that show a mass : n times (h, w), delays and bent lines included; none without a pose."""
    inside, scale = distances(masses, echo_power.beam_grid(world_from_pixel, shape, SPACING_MM)), pixel_mm(world_from_pixel)

    def mask(matrix: Array) -> Mask:
        placed = np.isfinite(matrix).all()
        return follow(inside, scale, matrix, shape, sound).inside if placed else np.zeros(shape, bool)

    return threads.mapped(mask, world_from_pixel)


def refined(masses: Sequence[Mass], power: EchoPower, times: int) -> list[Mass]:
    """The same masses with their surfaces moved to the borders in the power, some times over."""

    def refine(mass: Mass) -> Mass:
        for _ in range(times):
            mass = evened(replace(mass, mesh=border_fit.refine(mass.mesh, power, mass.bright)), power.volume.directions)
        return mass

    return list(threads.mapped(refine, masses, most=len(masses)))
