"""Reconstruct the surface in the common view of a camera and the projector.

Reads a capture folder, whether devices or the twin wrote it, or a bare folder of images with its patterns and calibration.
Writes surface.ply (mm, with the surface's grey), surface.glb (metres, y up), points.npz (the point of every pixel, with its
predicted sigma) and metrics.json into the folder `out`; results that are there already are replaced. Takes three seconds for
nine images of 1280x1024 and some seconds to start; the first run ever also compiles, for about a minute. Patterns are fringes
with what numbers them, or Gray code alone, by which points are known to a projector pixel. If other cameras of the
capture took the sequence as well, the share of the points that they see alike is said.

    sonotwin surface capture=outputs/demo/capture out=outputs/demo/surface
    sonotwin surface capture=shots calibration=calibration/optics.yaml out=outputs/shots
    sonotwin surface images=shots patterns=paper_surface calibration=optics.yaml out=outputs/shots
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from recon.capture import surface_part
from recon.capture.surface_part import SurfaceCapture
from recon.errors import Implausible, InputError
from recon.files import atomic, meshes, metrics
from recon.files.metrics import shown
from recon.model.rig import Part
from recon.structured_light import decode, ray_checks, surface_figures, surface_mesh
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.triangulate import PointMap, Triangulator
from sonotwin import choices

POINTS = "points.npz"
MOSTLY = 0.8  # share of the triangulated points, beyond which those that are removed make a warning


class Config(Part):
    """Fields of `sonotwin surface`: sources, target, and limits of the surface."""

    out: Path
    """folder; gets surface.ply, surface.glb, points.npz, metrics.json"""
    capture: Path | None = None
    """a capture folder, with its manifest.json; calibration takes the place of its own. Or else these three:"""
    images: Path | None = None
    """folder of images (PNG, BMP, TIFF, JPEG), one a pattern, in natural order"""
    patterns: str | None = None
    """YAML file of the pattern sequence, or the name of one in conf/patterns"""
    calibration: Path | None = None
    """calibration file"""
    camera: str = "cam1"
    """which camera's images"""
    implausible: Implausible = "refuse"
    """images that make no scene of camera and projector, or that a second camera contradicts: refuse, or take, with a warning"""
    limits: surface_mesh.Limits = surface_mesh.Limits()
    """what counts as surface; a sampling step is the width of a pixel at the point"""


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


def run(config: Config) -> None:
    """Read, decode, triangulate, clean, mesh and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, `out` can't be written to, or the devices have no view in common.
    """
    atomic.check_folder(config.out, "surface", inputs=sources(config))
    watch = Stopwatch()
    with watch.stage("read"):
        shots = read(config)
    camera, projector = shots.calibration.cameras[config.camera], shots.calibration.cameras["projector"]

    with watch.stage("decode"):
        found = decode.decode(shots.images, shots.patterns, bits=shots.bits, name=shots.name, camera=config.camera)
    for line in surface_figures.describe_decoding(shots.patterns, found):
        print(line)

    with watch.stage("rays"):
        triangulate = Triangulator(camera, projector)
    with watch.stage("triangulate"):
        raw = triangulate(found, config.implausible)
        ray_checks.check(found, raw, camera, projector, shots.name, config.implausible)
    with watch.stage("second_view"):  # the demo has a step of the name "compare"
        for line in compared(config, shots, found, raw):
            print(line)
    with watch.stage("clean"):
        cleaned = surface_mesh.clean(raw, camera, found.modulation, config.limits)
    if not np.isfinite(cleaned.points).any():
        found_none = nothing_left(raw, config.limits)
        raise InputError(f"{shots.name}: expected a surface that camera and projector both see, found {found_none}")
    with watch.stage("mesh"):
        mesh = surface_mesh.mesh(cleaned, camera, config.limits.max_slope, found.offset)
    predicted = {"predicted_rms_mm": surface_figures.predicted_rms(mesh, camera), "triangles": len(mesh.faces)}
    figures = surface_figures.measure(found, raw, cleaned) | predicted
    points, sigma = f"{figures['points']:,}".replace(",", " "), shown(figures["predicted_rms_mm"], ".3f", " mm")
    print(f"triangulate {points} points, predicted sigma {sigma}, {figures['removed_px']} px removed as unsure")
    if figures["removed_px"] > MOSTLY * (figures["points"] + figures["removed_px"]):
        print(
            "warning     most of the points are unsure: does the calibration take points from camera 1 to the projector, and not "
            "back, are the patterns those projected, or is the scene very dark?"
        )

    with atomic.new_folder(config.out, "surface") as folder:
        with watch.stage("write"):
            meshes.write_ply(folder / "surface.ply", mesh)
            meshes.write_glb(folder / "surface.glb", mesh)
            images = {"points": cleaned.points, "sigma": cleaned.sigma, "modulation": found.modulation, "status": found.status}
            np.savez_compressed(folder / POINTS, **images)
        metrics.write(folder / metrics.FILE, figures | watch.seconds)
    print(f"wrote       {config.out}/{{surface.ply,surface.glb,{POINTS},{metrics.FILE}}}")


def compared(config: Config, shots: SurfaceCapture, found: ProjectorMap, raw: PointMap) -> Iterator[str]:
    """Lines: the share of the points that the capture's other cameras see alike, or why one can't be compared.

    Raises
    ------
    InputError
        If one of them sees something else.
    """
    if config.capture is None:
        return
    for name in surface_part.cameras_beside(config.capture, config.camera):
        if name not in shots.calibration.cameras:
            yield f"compare     {name} isn't compared: it has no calibration"
            continue
        try:
            its = surface_part.read_surface(config.capture, name, config.calibration)
            other = decode.decode(its.images, its.patterns, bits=its.bits, name=f"{its.name}: {name}", camera=name)
        except InputError as fault:
            yield f"compare     {name} isn't compared: {fault}"
            continue
        beside = its.calibration.cameras[name]
        alike = ray_checks.check_beside(found, raw, other, beside, shots.name, config.implausible)
        if np.isfinite(alike):
            yield f"compare     {name} sees {100 * alike:.0f} % of the points alike"


def nothing_left(raw: PointMap, limits: surface_mesh.Limits) -> str:
    """The reason why no point is left, in words."""
    sigma = raw.sigma[np.isfinite(raw.points[..., 0])]
    if not sigma.size:
        return "no point of it"
    return (
        f"{sigma.size} points, all removed as unsure, of a predicted sigma of {np.median(sigma):.2g} mm: is the pitch of the "
        f"fringes, or of Gray code alone, too coarse? limits.max_sigma={limits.max_sigma:g} sampling steps may be raised"
    )


def read(config: Config) -> SurfaceCapture:
    """Read the capture, or the bare folder of images.

    Raises
    ------
    InputError
        If the fields name no source or two, or a source is damaged.
    """
    bare = {"images": config.images, "patterns": config.patterns, "calibration": config.calibration}
    given = [name for name, value in bare.items() if value is not None]
    if config.capture is not None:
        if doubled := ", ".join(name for name in given if name != "calibration"):
            raise InputError(f"surface: expected capture, or images with patterns and calibration, found both: {doubled}")
        return surface_part.read_surface(config.capture, config.camera, config.calibration)
    if config.images is None or config.patterns is None or config.calibration is None:
        found = ", ".join(given) or "none of them"
        raise InputError(f"surface: expected capture, or images with patterns and calibration, found {found}")
    return surface_part.read_bare(config.images, choices.read_patterns(config.patterns), config.calibration, config.camera)


def sources(config: Config) -> list[Path]:
    """Files and folders to be read."""
    patterns = None if config.patterns is None else choices.file_of("patterns", config.patterns)
    return [path for path in (config.capture, config.images, patterns, config.calibration) if path is not None]
