"""The surface by fringes in the view of a camera and the projector: the settings of the step, the step, and its files."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.capture import surface_part
from recon.capture.surface_part import SurfaceCapture
from recon.errors import Implausible, InputError
from recon.files import atomic, meshes, metrics
from recon.files.metrics import Metrics, shown
from recon.geometry.camera import Camera
from recon.model.patterns import Patterns
from recon.model.rig import Part
from recon.registry import Choice
from recon.session.watch import SILENT, Watch
from recon.structured_light import decode, ray_checks, second_view, surface_figures, surface_mesh
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.second_view import Fused, View
from recon.structured_light.surface_mesh import Limits
from recon.structured_light.triangulate import PointMap, Triangulator

BY = "surface"  # who writes
POINTS, SKIN, GLB = "points.npz", "surface.ply", "surface.glb"
MOSTLY = 0.8  # share of the triangulated points, beyond which those that are removed make a warning


class Settings(Part):
    """Sources, and limits of the surface."""

    capture: Path | None = None
    """a capture folder, with its manifest.json; calibration takes the place of its own. Or else these three:"""
    images: Path | None = None
    """folder of images (PNG, BMP, TIFF, JPEG), one a pattern, in natural order"""
    patterns: Annotated[Patterns | None, Choice(None)] = None
    """the pattern sequence: a name in conf/patterns, or a YAML file"""
    calibration: Path | None = None
    """calibration file"""
    camera: str = "cam1"
    """which camera's images"""
    implausible: Implausible = "refuse"
    """images that make no scene of camera and projector, or that a second camera contradicts: refuse, or take, with a warning"""
    limits: Limits = Limits()
    """what counts as surface; a sampling step is the width of a pixel at the point"""


@dataclass(frozen=True)
class Skin:
    """A surface by light: a point a pixel with its predicted sigma, and triangles."""

    found: ProjectorMap
    points: PointMap  # of what counts as surface
    mesh: trimesh.Trimesh
    figures: Metrics


class Stopwatch:
    """Seconds spent in each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body."""
        start = time.perf_counter()
        yield
        self.seconds[f"seconds_{name}"] = round(time.perf_counter() - start, 4)


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> None:
    """Read, decode, triangulate, clean, mesh and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, `out` can't be written to, or the devices have no view in common.
    """
    sources = (settings.capture, settings.images, settings.calibration)
    atomic.check_folder(out, BY, inputs=sources)
    clock = Stopwatch()
    with clock.stage("read"):
        shots = read(settings)
    skin = reconstruct(shots, settings.camera, settings.limits, settings.implausible, cameras_beside(settings), watch, clock)
    with atomic.new_folder(out, BY) as folder:
        with clock.stage("write"):
            meshes.write_ply(folder / SKIN, skin.mesh)
            meshes.write_glb(folder / GLB, skin.mesh)
            images = {"points": skin.points.points, "sigma": skin.points.sigma}
            np.savez_compressed(folder / POINTS, **images, modulation=skin.found.modulation, status=skin.found.status)
        metrics.write(folder / metrics.FILE, skin.figures | clock.seconds)
    watch.say(f"wrote       {out}/{{{SKIN},{GLB},{POINTS},{metrics.FILE}}}")


def reconstruct(
    shots: SurfaceCapture,
    camera: str = "cam1",
    limits: Limits | None = None,
    implausible: Implausible = "refuse",
    others: Mapping[str, Callable[[], SurfaceCapture]] | None = None,
    watch: Watch = SILENT,
    clock: Stopwatch | None = None,
) -> Skin:
    """Reconstruct the surface that a camera sees under a fringe sequence.

    Parameters
    ----------
    others : cameras that took the same sequence, by name, with what reads their images
    clock : keeps the seconds of each stage

    Raises
    ------
    InputError
        If the images make no scene, another camera contradicts, or the devices have no view in common.
    """
    limits, clock = limits or Limits(), clock or Stopwatch()
    by, projector = shots.calibration.cameras[camera], shots.calibration.cameras["projector"]
    with clock.stage("decode"):
        found = decode.decode(shots.images, shots.patterns, bits=shots.bits, name=shots.name, camera=camera)
    for line in surface_figures.describe_decoding(shots.patterns, found):
        watch.say(line)
    with clock.stage("rays"):
        triangulate = Triangulator(by, projector)
    with clock.stage("triangulate"):
        raw = triangulate(found, implausible)
        ray_checks.check(found, raw, by, projector, shots.name, implausible)
    with clock.stage("second_view"):
        added = []
        for view in beside(shots, others or {}, found, raw, implausible, watch):
            fused = second_view.fuse(View(by, found, raw), view, projector)
            watch.say(describe_fusion(view, fused))
            raw = fused.first
            if fused.shared.any():
                added.append((view._replace(raw=fused.second), fused.places))
    skin = surface_of(found, raw, by, limits, shots.name, clock)
    with clock.stage("seen_alone"):
        skin = with_more(skin, added, limits)
    figures = skin.figures
    points, sigma = f"{figures['points']:,}".replace(",", " "), shown(figures["predicted_rms_mm"], ".3f", " mm")
    watch.say(f"triangulate {points} points, predicted sigma {sigma}, {figures['removed_px']} px removed as unsure")
    if figures["removed_px"] > MOSTLY * (figures["points"] + figures["removed_px"]):
        watch.say(
            "warning     most of the points are unsure: does the calibration take points from camera 1 to the projector, and not "
            "back, are the patterns those projected, or is the scene very dark?"
        )
    return skin


def surface_of(
    found: ProjectorMap,
    raw: PointMap,
    camera: Camera,
    limits: Limits | None = None,
    name: str = "surface",
    clock: Stopwatch | None = None,
) -> Skin:
    """The surface of triangulated points, less what is unsure; InputError if nothing is left."""
    limits, clock = limits or Limits(), clock or Stopwatch()
    with clock.stage("clean"):
        cleaned = surface_mesh.clean(raw, camera, found.modulation, limits)
    if not np.isfinite(cleaned.points).any():
        expected = "expected a surface that camera and projector both see"
        raise InputError(f"{name}: {expected}, found {nothing_left(raw, limits)}")
    with clock.stage("mesh"):
        mesh = surface_mesh.mesh(cleaned, camera, limits.max_slope, found.offset)
    predicted = {"predicted_rms_mm": surface_figures.predicted_rms(mesh, camera), "triangles": len(mesh.faces)}
    return Skin(found, cleaned, mesh, surface_figures.measure(found, raw, cleaned) | predicted)


def beside(
    shots: SurfaceCapture,
    others: Mapping[str, Callable[[], SurfaceCapture]],
    found: ProjectorMap,
    raw: PointMap,
    implausible: Implausible,
    watch: Watch = SILENT,
) -> Iterator[View]:
    """Other cameras' views of the same fringes; says what share of the points each sees alike, or why it is left out.

    Raises
    ------
    InputError
        If one of them sees something else.
    """
    for name, read_its in others.items():
        if name not in shots.calibration.cameras:
            watch.say(f"compare     {name} isn't compared: it has no calibration")
            continue
        try:
            its = read_its()
            camera, projector = its.calibration.cameras[name], its.calibration.cameras["projector"]
            other = decode.decode(its.images, its.patterns, bits=its.bits, name=f"{its.name}: {name}", camera=name)
            points = Triangulator(camera, projector)(other, implausible)
        except InputError as fault:
            watch.say(f"compare     {name} isn't compared: {fault}")
            continue
        watch.say(f"compare     {name}: {surface_figures.describe_unwrapping(its.patterns, other)}")
        alike = ray_checks.check_beside(found, raw, other, camera, shots.name, implausible)
        if np.isnan(alike):
            watch.say(f"compare     {name} isn't compared: both see too few points in common")
            continue
        watch.say(f"compare     {name} sees {100 * alike:.0f} % of the points alike")
        yield View(camera, other, points)


def describe_fusion(view: View, fused: Fused) -> str:
    """A line: the points that another camera improves, or why it improves none."""
    name = view.camera.name
    if fused.shared.any():
        both, apart = (f"{np.count_nonzero(mask):,}".replace(",", " ") for mask in (fused.shared, fused.apart))
        return f"fuse        {name} measures {both} points, too; {apart} left out, through which one of both sees"
    if np.isnan(fused.bias_px):
        return f"fuse        {name} improves no point: both cameras see too few alike"
    cause = "devices that drifted, which sonotwin correct-optics corrects, or another calibration?"
    return f"warning     {name} improves no point: the calibration parts both by {fused.bias_px:.2f} projector px: {cause}"


def with_more(skin: Skin, views: Sequence[tuple[View, NDArray[np.int64]]], limits: Limits) -> Skin:
    """A skin with what other cameras see of it beside the first one's points.

    views : of other cameras, each with the first one's pixels of its points, as in `second_view.Fused`
    """
    meshes_of = [skin.mesh]
    for view, places in views:
        more = surface_mesh.clean(view.raw, view.camera, view.found.modulation, limits)
        more = second_view.alone(view._replace(raw=more), places, skin.points)
        if np.isfinite(more.points).any():
            meshes_of.append(surface_mesh.mesh(more, view.camera, limits.max_slope, view.found.offset))
    mesh = meshes.join(meshes_of)
    more = {"points_added": len(mesh.vertices) - len(skin.mesh.vertices), "triangles": len(mesh.faces)}
    return replace(skin, mesh=mesh, figures=skin.figures | more)


def cameras_beside(settings: Settings) -> dict[str, Callable[[], SurfaceCapture]]:
    """The capture's other cameras that took the sequence, with what reads their images."""
    if settings.capture is None:
        return {}
    names = surface_part.cameras_beside(settings.capture, settings.camera)
    return {name: partial(surface_part.read_surface, settings.capture, name, settings.calibration) for name in names}


def nothing_left(raw: PointMap, limits: surface_mesh.Limits) -> str:
    """The reason why no point is left, in words."""
    sigma = raw.sigma[np.isfinite(raw.points[..., 0])]
    if not sigma.size:
        return "no point of it"
    return (
        f"{sigma.size} points, all removed as unsure, of a predicted sigma of {np.median(sigma):.2g} mm: is the pitch of the "
        f"fringes, or of Gray code alone, too coarse? limits.max_sigma={limits.max_sigma:g} sampling steps may be raised"
    )


def read(settings: Settings) -> SurfaceCapture:
    """Read the capture, or the bare folder of images.

    Raises
    ------
    InputError
        If the fields name no source or two, or a source is damaged.
    """
    bare = {name: getattr(settings, name) for name in ("images", "patterns", "calibration")}
    given = [name for name, value in bare.items() if value is not None]
    if settings.capture is not None:
        if doubled := ", ".join(name for name in given if name != "calibration"):
            raise InputError(f"surface: expected capture, or images with patterns and calibration, found both: {doubled}")
        return surface_part.read_surface(settings.capture, settings.camera, settings.calibration)
    if settings.images is None or settings.patterns is None or settings.calibration is None:
        found = ", ".join(given) or "none of them"
        raise InputError(f"surface: expected capture, or images with patterns and calibration, found {found}")
    return surface_part.read_bare(settings.images, settings.patterns, settings.calibration, settings.camera)
