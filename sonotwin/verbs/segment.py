"""Find masses, or a tube, in the B-scans of a freehand sweep, as closed surfaces in the world.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker, or a tracked
sequence of the PLUS toolkit; and, to tell whether masses lie inside, the skin as of `sonotwin surface`, a PLY. Writes into the
folder `out`: mass0.ply, mass1.ply ... from the largest on, or tube.ply, in the world's frame, mm; the same as .glb; some B-scans
with the outline, overlay0.png ...; and metrics.json. Results that are there already are replaced. Takes about a minute for 150
B-scans, a tube some seconds.

    sonotwin segment capture=outputs/sweep/capture lag_s=0.05 tissue_m_s=1450 out=outputs/masses
    sonotwin segment capture=outputs/sweep/capture lag_s=0.05 surface=outputs/surface/surface.ply out=outputs/masses
    sonotwin segment kind=tube capture=outputs/tank/capture probe=outputs/probe/probe.yaml lag_s=0.05 out=outputs/tube
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from rich.console import Console

from recon.capture import sweep_part
from recon.errors import InputError
from recon.files import atomic, meshes, metrics
from recon.files.metrics import Metrics
from recon.model.probe import SCANNER_SPEED, ProbeCalibration, Speed
from recon.model.rig import Positive
from recon.segmentation import masses, tube_wall
from recon.segmentation.containment import Containment, contain
from recon.segmentation.masses import Mass
from recon.segmentation.refraction import Sound
from recon.segmentation.tube_wall import Appearance, Ring, Tube
from sonotwin.verbs import freehand
from sonotwin.verbs.freehand import Scans
from sonotwin.verbs.measure_lag import LagSeconds

Array = NDArray[np.float64]
Spread = Annotated[float, Field(ge=0, le=5)]

LEAST_PX = 30  # of a mass in a B-scan that is drawn
COLOUR = (60, 220, 255)  # of outlines, blue, green, red


class Config(BaseModel):
    """Fields of `conf/segment.yaml`."""

    model_config = ConfigDict(extra="forbid")

    out: Path
    kind: Literal["masses", "tube"] = "masses"
    capture: Path | None = None
    probe: Path | None = None
    lag_s: LagSeconds = 0.0
    sequence: Path | None = None
    surface: Path | None = None
    tissue_m_s: Speed | None = None
    mass_m_s: Speed = SCANNER_SPEED
    dynamic_range_db: Annotated[float, Field(ge=20, le=120)] = 60.0
    diameter_mm: tuple[Positive, Positive] = (5.0, 36.0)
    spread_mm: tuple[Spread, Spread] = (0.25, 0.08)
    min_contrast_db: Annotated[float, Field(ge=0, le=120)] = 15.0
    top_mm: Annotated[float, Field(ge=0, le=100)] = 2.5
    overlays: Annotated[int, Field(ge=0, le=100)] = 4

    @model_validator(mode="after")
    def _one_source(self) -> "Config":
        if (self.capture is None) == (self.sequence is None):
            raise ValueError(f"expected capture or sequence, found {'neither' if self.capture is None else 'both'}")
        if self.sequence is not None and self.lag_s != 0:
            raise ValueError(f"lag_s: expected none with a sequence, whose poses are those of its images, found {self.lag_s:g}")
        if self.kind == "tube" and self.surface is not None:
            raise ValueError("surface: expected none with kind=tube, found one")
        if self.diameter_mm[0] >= self.diameter_mm[1]:
            raise ValueError(f"diameter_mm: expected the least before the most, found {list(self.diameter_mm)}")
        return self

    @property
    def tube(self) -> Appearance:
        """What a tube looks like."""
        return Appearance(self.diameter_mm, self.spread_mm, self.dynamic_range_db, self.min_contrast_db, self.top_mm)


@dataclass(frozen=True)
class Found:
    """What was segmented."""

    meshes: dict[str, trimesh.Trimesh]  # by the files' names
    figures: Metrics
    lines: list[str]  # for the console
    overlays: list[tuple[int, NDArray[np.uint8]]]  # the image's number, and the image (h, w, 3)


def run(config: Config) -> None:
    """Read, segment and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, there is no tube where one is looked for, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    inputs = [path for path in (config.capture, config.probe, config.sequence, config.surface) if path is not None]
    atomic.check_folder(config.out, metrics.FILE, inputs=inputs)
    skin = None if config.surface is None else read_skin(config.surface)
    scans = read(config)
    height, width = scans.shape
    count = len(scans.world_from_pixel)
    console.print(f"read        {count} B-scans, {width}x{height}, {scans.placed} with a pose", markup=False)
    console.print(freehand.depths(scans), markup=False)
    start = perf_counter()
    with console.status(f"looking for {'a tube' if config.kind == 'tube' else 'masses'}"):
        found = find_tube(scans, config) if config.kind == "tube" else find_masses(scans, config, skin)
    for line in found.lines:
        console.print(line, markup=False)
    figures = {"frames": count, "frames_placed": scans.placed, "speed_m_per_s": scans.speed_m_s} | found.figures
    with console.status("writing"), atomic.new_folder(config.out, metrics.FILE) as folder:
        for name, mesh in found.meshes.items():
            meshes.write_ply(folder / f"{name}.ply", mesh)
            meshes.write_glb(folder / f"{name}.glb", mesh)
        for number, (_, image) in enumerate(found.overlays):
            (folder / f"overlay{number}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
        metrics.write(folder / metrics.FILE, figures | {"seconds_segment": round(perf_counter() - start, 3)})
        written = sorted(path.name for path in folder.iterdir())
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def read(config: Config) -> Scans:
    """The B-scans in the world."""
    if config.capture is None:
        assert config.sequence is not None
        return freehand.scans_of_sequence(config.sequence, config.probe, None, config.tissue_m_s)
    sweep = sweep_part.read_sweep(config.capture)
    probe = freehand.probe_of(sweep, config.capture, config.probe)
    return freehand.scans_of_sweep(sweep, probe, config.lag_s, config.tissue_m_s)


def read_skin(path: Path) -> trimesh.Trimesh:
    """A surface of triangles.

    Raises
    ------
    InputError
        If the file is none.
    """
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: expected a surface as PLY, found {path.suffix or 'no suffix'}")
    if not path.is_file():
        raise InputError(f"{path}: expected a surface as PLY, found none")
    try:
        mesh = trimesh.load(path, file_type="ply", process=False)
    except (ValueError, IndexError, KeyError, TypeError) as error:
        raise InputError(f"{path}: expected a surface as PLY, found a damaged one: {error}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: expected a surface of triangles, found none in it")
    return mesh


def find_masses(scans: Scans, config: Config, skin: trimesh.Trimesh | None) -> Found:
    """Masses, with the outlines that the B-scans show of them."""
    sound, placed = Sound(scans.speed_m_s, config.mass_m_s), scans.world_from_pixel
    try:
        grey = masses.tissue_grey(scans.stream(), scans.shape, placed)
    except InputError as error:
        raise InputError(f"{config.capture or config.sequence}: {error}") from None
    found = masses.from_scans(scans.stream, scans.shape, placed, sound, config.dynamic_range_db, grey)
    figures: Metrics = {"tissue_grey": grey, "masses": len(found)}
    lines = [f"tissue      grey {grey:.0f} of 255"]
    lines += (
        []
        if found
        else ["masses      none: no body darker than the tissue on all sides of it; one at the images' side needs strokes beside"]
    )
    for number, mass in enumerate(found):
        under = None if skin is None else contain(mass.mesh, skin)
        figures |= measure(f"mass{number}", mass, under)
        lines.append(f"mass{number}       {describe(mass, under)}")
    shown = masses.shown(found, placed, scans.shape, sound)
    outlines = {k: mask for k, mask in enumerate(shown) if mask.sum() >= LEAST_PX}
    chosen = spread({k: int(mask.sum()) for k, mask in outlines.items()}, config.overlays)
    drawn = [(k, drawn_over(image, list(_contours(outlines[k])))) for k, image in enumerate(scans.stream()) if k in chosen]
    return Found({f"mass{k}": mass.mesh for k, mass in enumerate(found)}, figures, lines, drawn)


def measure(name: str, mass: Mass, under: Containment | None) -> Metrics:
    """Figures of a mass, each named with its unit."""
    figures: Metrics = {f"{name}_volume_mm3": mass.volume}
    figures |= {f"{name}_centre_{axis}_mm": float(value) for axis, value in zip("xyz", mass.centre, strict=True)}
    figures |= {f"{name}_extent_{axis}_mm": float(value) for axis, value in zip("xyz", mass.mesh.extents, strict=True)}
    if under is not None:
        inside = np.nan if under.inside is None else int(under.inside)
        figures |= {f"{name}_inside": inside, f"{name}_covered": under.covered, f"{name}_depth_mm": under.least_mm}
    return figures


def describe(mass: Mass, under: Containment | None) -> str:
    """One line about a mass."""
    centre = ", ".join(f"{value:.1f}" for value in mass.centre)
    text = f"{mass.volume:.0f} mm3, centre {centre} mm, {' x '.join(f'{value:.1f}' for value in mass.mesh.extents)} mm"
    if under is None:
        return text
    if under.inside is None:
        return f"{text}, inside unknown: only {100 * under.covered:.0f} % lies under the surface"
    return f"{text}, {'inside' if under.inside else 'not inside'}, {metrics.shown(under.least_mm, '.1f')} mm below the skin"


def find_tube(scans: Scans, config: Config) -> Found:
    """A tube, with its wall in the B-scans."""
    matrices = scans.world_from_pixel
    scale = np.array(masses.pixel_mm(matrices))
    rings = [tube_wall.find(image, scale, config.tube) for image in scans.stream()]
    try:
        tube = tube_wall.fit_tube(rings, matrices)
    except InputError as error:
        reasons = [one.reason for one in rings if one.reason]
        found = f"; most others: {max(set(reasons), key=reasons.count)}" if reasons else ""
        raise InputError(f"{config.capture or config.sequence}: {error}{found}") from None
    used = len(np.unique(tube.frames))
    of_scale = 0.0 if scans.probe is None else scale_sigma(rings, matrices, tube, scans.probe)
    diameter, sigma = 2 * tube.shape.radius, 2 * float(np.hypot(tube.sigma_mm, of_scale))
    figures: Metrics = {
        "tube_diameter_mm": diameter,
        "tube_diameter_sigma_mm": sigma,
        "tube_rms_mm": tube.rms,
        "tube_frames": used,
        **{f"tube_axis_{axis}": float(value) for axis, value in zip("xyz", tube.shape.axis, strict=True)},
        **{f"tube_point_{axis}_mm": float(value) for axis, value in zip("xyz", tube.shape.point, strict=True)},
    }
    line = f"tube        {diameter:.3f} mm in diameter, sigma {sigma:.3f} mm, {used} B-scans, RMS {tube.rms:.3f} mm"
    chosen = spread({int(k): len(rings[k].pixels) for k in np.unique(tube.frames)}, config.overlays)
    drawn = [(k, drawn_over(image, [rings[k].pixels], closed=False)) for k, image in enumerate(scans.stream()) if k in chosen]
    return Found({"tube": tube_mesh(tube, rings, matrices)}, figures, [line], drawn)


def scale_sigma(rings: Sequence[Ring], matrices: Array, tube: Tube, probe: ProbeCalibration) -> float:
    """Standard deviation of a tube's radius, mm, by that of sx and sy, which all images have in common; 0 if none is known."""
    known = probe.uncertainty
    if known is None:
        return 0.0
    names = [name for name in ("sx", "sy") if known.sigma(name) > 0]
    steps = []
    for name in names:
        k = ("sx", "sy").index(name)
        changed = np.ones(4)
        changed[k] += known.sigma(name) / probe.scale[k]
        steps.append((tube_wall.fit_tube(rings, matrices * changed).shape.radius - tube.shape.radius) / known.sigma(name))
    order = [known.names.index(name) for name in names]
    return float(np.sqrt(np.array(steps) @ known.covariance[np.ix_(order, order)] @ np.array(steps))) if names else 0.0


def tube_mesh(tube: Tube, rings: Sequence[Ring], matrices: Array) -> trimesh.Trimesh:
    """The cylinder, as long as what was seen of it."""
    points = np.concatenate([tube_wall.in_world(rings[k].pixels, matrices[k]) for k in np.unique(tube.frames)])
    along = (points - tube.shape.point) @ tube.shape.axis
    ends = tube.shape.point + np.outer([along.min(), along.max()], tube.shape.axis)
    return trimesh.creation.cylinder(tube.shape.radius, segment=ends, sections=96)


def spread(sizes: dict[int, int], count: int) -> set[int]:
    """Some of the images that show something, evenly through the sweep: of each part the one that shows most."""
    parts = np.array_split(sorted(sizes), min(count, len(sizes))) if count and sizes else []
    return {max(part.tolist(), key=lambda k: sizes[k]) for part in parts}


def drawn_over(image: NDArray[np.uint8], outlines: Sequence[NDArray], closed: bool = True) -> NDArray[np.uint8]:
    """A B-scan in colour : (h, w, 3), with outlines : (m, 2) px."""
    result = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for outline in outlines:
        points = np.rint(16 * np.asarray(outline)).astype(np.int32)[:, None]
        cv2.polylines(result, [points], closed, COLOUR, 1, cv2.LINE_AA, shift=4)
    return result


def _contours(mask: NDArray[np.bool_]) -> Iterator[NDArray]:
    return (line[:, 0] for line in cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0])
