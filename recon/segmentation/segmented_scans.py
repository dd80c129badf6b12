"""Masses, or a tube, in the B-scans of a sweep: closed surfaces, their figures, and B-scans with the outlines drawn over."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.metrics import Metrics, shown
from recon.freehand import place_uncertainty
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Scans
from recon.geometry.primitives import Cylinder
from recon.model.probe import SCANNER_SPEED
from recon.segmentation import contact, mass_uncertainty, masses, rest, rough_bodies, scan_overlays, tube_cover, tube_wall
from recon.segmentation.blur_correction import Blur
from recon.segmentation.containment import Containment, contain
from recon.segmentation.left_out import LeftOut
from recon.segmentation.mass_network import Looks
from recon.segmentation.mass_uncertainty import Sigma, Speeds
from recon.segmentation.masses import Mass
from recon.segmentation.refraction import Sound
from recon.segmentation.scan_overlays import Overlay
from recon.segmentation.tube_cover import Cover
from recon.segmentation.tube_wall import Appearance, Ring, Tube

Array = NDArray[np.float64]

OVERLAYS = 4
DOUBTED = 0.12  # of a mass's volume, from which on twice its standard deviation is warned of
VOLUME_WARNING = "warning     volume:"
COVER = ("cover_diameter_mm", "cover_rms_mm", "cover_wall_mm", "cover_wall_sigma_mm")  # figures


@dataclass(frozen=True)
class Segmented:
    """Surfaces of a sweep, with their figures and pictures."""

    meshes: dict[str, trimesh.Trimesh]  # by the files' names
    figures: Metrics
    lines: list[str]  # for the console
    overlays: list[Overlay]
    left_out: tuple[LeftOut, ...] = ()  # by a search for masses
    scans: Scans | None = None  # in which masses were sought: as of the body at rest


def find_masses(
    scans: Scans,
    skin: trimesh.Trimesh | None = None,
    mass_m_s: float = SCANNER_SPEED,
    dynamic_range_db: float = 60.0,
    overlays: int = OVERLAYS,
    speed_sigmas: tuple[float, float] = (0.0, 0.0),
    blur: Blur | None = None,
    looks: Looks | None = None,
) -> Segmented:
    """Find masses; with a skin, whether they lie under it.

    speed_sigmas : m/s, standard deviations of the speeds of sound in the tissue and in masses.
    blur, looks : as of `masses.from_scans`.

    Raises
    ------
    InputError
        As `recon.segmentation.masses.from_scans`.
    """
    scans = freehand_scans.in_memory(scans)  # they are read five times and more
    touching = moved = None
    if skin is not None:
        touching = contact.measure(scans, skin)
        moved = rest.find(scans, skin, touching)
    if moved is not None:
        scans = freehand_scans.in_memory(rest.undone(scans, moved))
    sound, placed = Sound(scans.speed_m_s, mass_m_s), scans.world_from_pixel
    grey = masses.tissue_grey(scans.stream(), scans.shape, placed)
    found, left_out, uneven_db = masses.from_scans(scans.stream, scans.shape, placed, sound, dynamic_range_db, grey, blur, looks)
    figures: Metrics = {"tissue_grey": grey, "masses": len(found), "left_out": len(left_out)}
    none_found = "none: no body that differs from the tissue on all sides of it; one at the images' side needs strokes beside"
    if np.isfinite(uneven_db):
        figures["tissue_uneven_db"] = uneven_db
    by_looks = (looks or Looks()).sees(uneven_db)
    sought = ": as a breast, masses are told by their looks" if by_looks else ""
    if not by_looks and uneven_db >= rough_bodies.FAINT.even_db:
        sought = ": too uneven for bright or faint masses, none were looked for"
    lines = [
        f"tissue      grey {grey:.0f} of 255, uneven by {uneven_db:.1f} dB{sought}",
        *([] if found else [f"masses      {none_found}"]),
    ]
    lines += [f"blur        {blur}"] if blur is not None and found and not by_looks else []
    for one in (touching, moved):
        figures |= {} if one is None else one.figures
        lines += [] if one is None else one.lines
    containments = [None] * len(found) if skin is None else contain([mass.mesh for mass in found], skin)
    for number, (mass, under) in enumerate(zip(found, containments, strict=True)):
        speeds = Speeds(speed_sigmas[0] / scans.speed_m_s, speed_sigmas[1] / mass_m_s)
        sigma = mass_uncertainty.by_all(mass, scans, speeds, under, moved)
        figures |= measure(f"mass{number}", mass, sigma, under)
        lines.append(f"mass{number}       {describe(mass, sigma, under)}")
        if moved is not None:
            figures[f"mass{number}_left_sigma_mm"] = sigma.left_mm
            lines += rest.warnings_of(f"mass{number}", sigma.left_mm)
        lines += doubts(f"mass{number}", mass, sigma)
    drawn = scan_overlays.of_masks(scans.stream(), masses.shown(found, placed, scans.shape, sound), overlays)
    return Segmented({f"mass{k}": mass.mesh for k, mass in enumerate(found)}, figures, lines, drawn, tuple(left_out), scans)


def measure(name: str, mass: Mass, sigma: Sigma, under: Containment | None) -> Metrics:
    """Figures of a mass, each named with its unit, with its uncertainty."""
    figures: Metrics = {
        f"{name}_volume_mm3": mass.volume,
        f"{name}_volume_sigma_mm3": sigma.volume_mm3,
        f"{name}_centre_sigma_mm": sigma.centre_mm,
    }
    figures |= {f"{name}_centre_{axis}_mm": float(value) for axis, value in zip("xyz", mass.centre, strict=True)}
    figures |= {f"{name}_extent_{axis}_mm": float(value) for axis, value in zip("xyz", mass.mesh.extents, strict=True)}
    if under is not None:
        inside = np.nan if under.inside is None else int(under.inside)
        figures |= {f"{name}_inside": inside, f"{name}_covered": under.covered, f"{name}_depth_mm": under.least_mm}
        figures[f"{name}_depth_sigma_mm"] = sigma.depth_mm
    return figures


def doubts(name: str, mass: Mass, sigma: Sigma) -> list[str]:
    """A warning, where a mass's volume is hardly known."""
    share = 2 * sigma.volume_mm3 / mass.volume
    return [f"{VOLUME_WARNING} {name}'s is known to {100 * share:.0f} % only (2 sigma)"] if share > DOUBTED else []


def describe(mass: Mass, sigma: Sigma, under: Containment | None) -> str:
    """One line: volume, centre and extent of a mass, and its depth below the skin."""
    centre = ", ".join(f"{value:.1f}" for value in mass.centre)
    known = zip(sigma[:3], (".1f", ".0f", ".2f"), strict=True)
    away, volume, deep = (f" ± {value:{how}}" if np.isfinite(value) else "" for value, how in known)
    extent = " x ".join(f"{value:.1f}" for value in mass.mesh.extents)
    text = f"{mass.volume:.0f}{volume} mm3, centre {centre}{away} mm, {extent} mm"
    text += ", brighter than the tissue" if mass.bright else ""
    text += ", touches another: perhaps they are one" if mass.beside else ""
    if under is None:
        return text
    if under.inside is None:
        return f"{text}, inside unknown: only {100 * under.covered:.0f} % lies under the surface"
    doubt = ", which has no sigma_mm there: uncertain by an unknown length" if np.isnan(under.sigma_mm) else ""
    return f"{text}, {'inside' if under.inside else 'not inside'}, {shown(under.least_mm, '.2f')}{deep} mm below the skin{doubt}"


def find_tube(
    scans: Scans, look: Appearance | None = None, overlays: int = OVERLAYS, surface: trimesh.Trimesh | None = None
) -> Segmented:
    """Find a tube, and its wall in the B-scans; with a surface by light, the round body about it, too.

    Raises
    ------
    InputError
        If fewer than three B-scans show its wall.
    """
    matrices = scans.world_from_pixel
    scale = np.array(masses.pixel_mm(matrices))
    rings = [tube_wall.find(image, scale, look) for image in scans.stream()]
    try:
        tube = tube_wall.fit_tube(rings, matrices)
    except InputError as error:
        reasons = [one.reason for one in rings if one.reason]
        most = f"; most others: {max(set(reasons), key=reasons.count)}" if reasons else ""
        raise InputError(f"{error}{most}") from None
    of_scale = 0.0 if scans.probe is None else tube_wall.scale_sigma(rings, matrices, tube, scans.probe)
    figures = _measure_tube(tube, of_scale)
    diameter, sigma, used = (figures[f"tube_{name}"] for name in ("diameter_mm", "diameter_sigma_mm", "frames"))
    line = f"tube        {diameter:.3f} mm in diameter, sigma {sigma:.3f} mm, {used} B-scans, RMS {tube.rms:.3f} mm"
    outlines = {int(k): rings[k].pixels for k in np.unique(tube.frames)}
    drawn = scan_overlays.of_outlines(scans.stream(), outlines, overlays)
    ends = _ends_of(tube, rings, matrices)
    inner = Segmented({"tube": between(tube.shape, ends)}, figures, [line], drawn)
    if surface is None:
        return inner
    try:
        return covered(inner, tube_cover.fit_cover(surface, tube.shape, ends), ends, _wall_sigma(scans, tube, rings))
    except InputError as error:
        unknown: Metrics = dict.fromkeys(COVER, float("nan"))
        return replace(inner, figures=inner.figures | unknown, lines=[*inner.lines, f"cover       none: {error}"])


def covered(inner: Segmented, cover: Cover, ends: Array, sigma_mm: float) -> Segmented:
    """The tube with the body about it, between the same ends.

    sigma_mm : standard deviation of the wall between both; NaN where it isn't known
    """
    values = 2 * cover.shape.radius, cover.rms_mm, cover.wall_mm, sigma_mm
    figures = inner.figures | dict(zip(COVER, values, strict=True))
    line = f"cover       {2 * cover.shape.radius:.3f} mm in diameter, RMS {cover.rms_mm:.3f} mm, wall {cover.wall_mm:.3f} mm"
    line += f" ± {sigma_mm:.3f}" if np.isfinite(sigma_mm) else ""
    return Segmented(inner.meshes | {"cover": between(cover.shape, ends)}, figures, [*inner.lines, line], inner.overlays)


def _wall_sigma(scans: Scans, tube: Tube, rings: Sequence[Ring]) -> float:
    """Standard deviation, mm, of the place of a tube's wall towards the camera; NaN where the calibration's isn't known.

    Noise of the fit is at most that of the radius. A drift that parts the surface by light from the tube isn't in it.
    """
    if scans.probe is None or scans.probe.uncertainty is None:
        return np.nan
    used, up = np.unique(tube.frames), tube_cover.to_camera(tube.shape)
    front = [rings[k].pixels[np.argmax(tube_wall.in_world(rings[k].pixels, scans.world_from_pixel[k]) @ up)] for k in used]
    directions = np.broadcast_to(up, (len(used), 3))
    placed = place_uncertainty.mean_sigma(scans.world_from_pixel, scans.probe, scans.errors, used, np.array(front), directions)
    return float(np.hypot(placed, tube.sigma_mm))


def _measure_tube(tube: Tube, of_scale_mm: float) -> Metrics:
    """Figures of a tube, each named with its unit, with the part of the radius' standard deviation due to the probe's scale."""
    return {
        "tube_diameter_mm": 2 * tube.shape.radius,
        "tube_diameter_sigma_mm": 2 * float(np.hypot(tube.sigma_mm, of_scale_mm)),
        "tube_rms_mm": tube.rms,
        "tube_frames": len(np.unique(tube.frames)),
        **{f"tube_axis_{axis}": float(value) for axis, value in zip("xyz", tube.shape.axis, strict=True)},
        **{f"tube_point_{axis}_mm": float(value) for axis, value in zip("xyz", tube.shape.point, strict=True)},
    }


def _ends_of(tube: Tube, rings: Sequence[Ring], matrices: Array) -> Array:
    """Ends : (2, 3) mm of the measured part of a tube, on its axis."""
    points = np.concatenate([tube_wall.in_world(rings[k].pixels, matrices[k]) for k in np.unique(tube.frames)])
    along = (points - tube.shape.point) @ tube.shape.axis
    return tube.shape.point + np.outer([along.min(), along.max()], tube.shape.axis)


def between(shape: Cylinder, ends: Array) -> trimesh.Trimesh:
    """A cylinder, between the feet of points : (2, 3) mm on its axis."""
    feet = shape.point + np.outer((ends - shape.point) @ shape.axis, shape.axis)
    return trimesh.creation.cylinder(shape.radius, segment=feet, sections=96)
