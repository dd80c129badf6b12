"""The map of what was seen: where a mass of some size and contrast would have been found, had there been one."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field, model_validator
from skimage.measure import marching_cubes

from recon.errors import validated
from recon.files import json_text, meshes, volumes
from recon.files.metrics import Metrics
from recon.files.volumes import Volume
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.part import Fraction, NotNegative, Part, Positive
from recon.segmentation import detectability, insonation
from recon.segmentation.detectability import OBSERVER, Ball, Calibration, Sought
from recon.segmentation.insonation import Insonation, Spread
from recon.segmentation.mass_network import Looks

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

VOLUME, SURFACE, TABLE = "seen.nrrd", "unseen.ply", "seen.json"  # files
SIZES_MM, CONTRASTS_DB = (4.0, 6.0, 8.0, 12.0, 20.0), (2.5, 5.0, 8.0, 15.0)  # of the table
WELL = 0.5  # of the probability that B-scans side by side give, from which a place counts as seen
OUTSIDE = -1  # in the volume's file: where the mass has no room, and beside what is to be scanned


class Insonified(Part):
    """How a scanned volume was insonified: medians of its voxels with a B-scan."""

    depth_mm: float
    """below the array's face"""
    under_mm: float
    """below the skin, or the face without one"""
    beam: tuple[float, float, float]
    """direction of the sound in the world, a unit vector"""
    turned_deg: NotNegative
    """standard deviation of that direction at a place"""
    axial_mm: NotNegative
    """sigma of an echo's power in depth"""
    lateral_mm: NotNegative
    """likewise across the beam where it is finest"""
    elevational_mm: NotNegative
    """likewise where it is coarsest"""
    gap_mm: NotNegative | None
    """widest gap between B-scans in a voxel; null where most lie beside what was scanned"""


class Table(Part):
    """Shares of what was scanned in which masses would have been found; the content of the file."""

    size_mm: Positive
    """of the mass that the map is for"""
    contrast_db: NotNegative
    """of it"""
    sizes_mm: tuple[Positive, ...] = SIZES_MM
    contrasts_db: tuple[NotNegative, ...] = CONTRASTS_DB
    shares: tuple[tuple[Fraction, ...], ...]
    """a row a size, a column a contrast"""
    trials: Annotated[int, Field(ge=0)] = 0
    """that the coefficients were fitted to; 0 of assumed ones"""
    insonified: Insonified | None = None
    """null where nothing was"""

    @model_validator(mode="after")
    def _whole(self) -> "Table":
        rows, columns = len(self.sizes_mm), len(self.contrasts_db)
        if [len(row) for row in self.shares] != rows * [columns]:
            found = f"{len(self.shares)} with {', '.join(str(len(row)) for row in self.shares) or 'none'}"
            raise ValueError(f"shares: expected {rows} rows with {columns} each, found {found}")
        return self

    @property
    def source(self) -> str:
        """Origin of the coefficients, for people."""
        return detectability.source(self.trials)


@dataclass(frozen=True, eq=False)
class Seen:
    """The map for one mass, and the table for others."""

    where: Insonation
    sought: Sought
    probability: Map  # (nz, ny, nx); 0 outside of the planned volume
    seen: Map  # (nz, ny, nx) over the probability that B-scans side by side give; beside the planned volume, too
    table: Table

    @property
    def room(self) -> Mask:
        """The planned volume."""
        return planned(self.where, self.sought.size_mm)

    @property
    def unseen(self) -> Mask:
        """Places that are still to be scanned : (nz, ny, nx)."""
        return self.room & (self.seen < WELL)

    @property
    def figures(self) -> Metrics:
        """Volumes of what was scanned that count as seen and as unseen, and the mean probability there."""
        scanned, voxel = self.room & self.where.hull, self.where.voxel_mm3
        return {
            "seen_mm3": float((scanned & (self.seen >= WELL)).sum()) * voxel,
            "unseen_mm3": float((scanned & (self.seen < WELL)).sum()) * voxel,
            "seen_probability": float(self.probability[scanned].mean()) if scanned.any() else 0.0,
        }

    @property
    def line(self) -> str:
        """A line for the console."""
        seen, unseen, chance = (self.figures[name] for name in ("seen_mm3", "unseen_mm3", "seen_probability"))
        what = f"a mass of {self.sought.size_mm:g} mm and {self.sought.contrast_db:g} dB"
        scanned = f"in the {(seen + unseen) / 1000:.0f} cm3 scanned, {self.table.source}"
        return f"seen        {what} is found with {100 * chance:.0f} % {scanned}; {unseen / 1000:.0f} cm3 were seen poorly"

    @property
    def volume(self) -> Volume:
        """The map as a volume, with OUTSIDE beside the planned one: 3D Slicer shows that as black, as NaN it may not."""
        grid = self.where.grid
        return Volume(np.where(self.room, self.probability, np.float32(OUTSIDE)), grid.origin, grid.spacing, grid.directions)


@dataclass(frozen=True, eq=False)
class SeenFiles:
    """The map as it lies in a folder of `sonotwin segment`."""

    volume: Path
    table: Table
    unseen: trimesh.Trimesh | None = None  # surface about what is still to be scanned


def planned(where: Insonation, size_mm: float) -> Mask:
    """Middles : (nz, ny, nx) of balls of a diameter that can be seen whole, in and beside what was scanned.

    They lie under the skin, below the ringing and above the images' lower end, so that a perfect sweep shows all of them.
    """
    return where.around & (where.room_mm >= size_mm / 2)


def probability(where: Insonation, sought: Sought, uneven_db: float, calibration: Calibration | None = None) -> tuple[Map, Map]:
    """Probability : (nz, ny, nx) that a mass in each place is found, and that over what B-scans side by side give.

    Those show all of the mass, without a blur of their spacing.
    """
    chosen, ball = calibration or detectability.calibration_for(uneven_db), detectability.ball_means(where, sought.size_mm)
    depth_mm = np.where(where.count > 0, where.depth_mm, where.under_mm)
    slice_mm = np.fmin(where.elevational_mm, where.tally.spread.across(depth_mm))
    found = _probability(ball, where.elevational_mm, sought, uneven_db, chosen)
    best = _probability(ball._replace(seen=np.ones_like(ball.seen)), slice_mm, sought, uneven_db, chosen)
    return found, found / np.maximum(best, np.finfo(np.float32).tiny)


def _probability(ball: Ball, elevational_mm: Map, sought: Sought, uneven_db: float, calibration: Calibration) -> Map:
    given = detectability.features(ball, elevational_mm, sought, uneven_db)
    return detectability.probability(given, calibration).astype(np.float32)


def look(
    where: Insonation, sought: Sought | None = None, uneven_db: float = OBSERVER.even_db, calibration: Calibration | None = None
) -> Seen:
    """The map for a mass, by how each place was seen, and the table.

    Parameters
    ----------
    uneven_db : of the tissue's power, as of `recon.segmentation.masses.from_scans`
    calibration : of the observer, by default the one for such tissue
    """
    chosen, calibration = sought or Sought(), calibration or detectability.calibration_for(uneven_db)
    rows = []
    for size in SIZES_MM:
        scanned = where.hull & planned(where, size)
        ball = detectability.ball_means(where, size)
        several = [Sought(size, contrast, chosen.bright) for contrast in CONTRASTS_DB]
        made = [_probability(ball, where.elevational_mm, one, uneven_db, calibration) for one in several]
        rows.append(tuple(float(one[scanned].mean()) if scanned.any() else 0.0 for one in made))
    there = planned(where, chosen.size_mm)
    found, seen = probability(where, chosen, uneven_db, calibration)
    found = np.where(there, found, np.float32(0))
    table = Table(
        size_mm=chosen.size_mm,
        contrast_db=chosen.contrast_db,
        shares=tuple(rows),
        trials=calibration.trials,
        insonified=insonified(where),
    )
    return Seen(where, chosen, found, seen, table)


def insonified(where: Insonation) -> Insonified | None:
    """Medians of what was scanned; None where nothing was."""
    there = where.hull & (where.count > 0)
    if not there.any():
        return None
    names = "depth_mm", "under_mm", "turned_deg", "lateral_mm", "elevational_mm"
    made = {name: float(np.median(getattr(where, name)[there])) for name in names}
    beam, gap = np.median(where.beam[there], axis=0), float(np.median(where.gap_mm[there]))
    x, y, z = (beam / np.linalg.norm(beam)).tolist()
    return Insonified(beam=(x, y, z), axial_mm=where.axial_mm, gap_mm=gap if np.isfinite(gap) else None, **made)


def of_scans(
    scans: Scans,
    skin: trimesh.Trimesh | None = None,
    spread: Spread | None = None,
    sought: Sought | None = None,
    uneven_db: float = OBSERVER.even_db,
    dynamic_range_db: float = 60.0,
    looks: Looks | None = None,
) -> Seen:
    """The map of a sweep's B-scans; see `look` and `recon.segmentation.insonation.of_sweep`, which raises InputError."""
    face_row = 0.0 if scans.probe is None else scans.probe.face_row
    placed, images = (scans.world_from_pixel, scans.shape), scans.stream()
    where = insonation.of_sweep(*placed, images, skin, spread, face_row, dynamic_range_db=dynamic_range_db)
    return look(where, sought, uneven_db, detectability.calibration_for(uneven_db, looks))


def unseen_surface(seen: Seen) -> trimesh.Trimesh | None:
    """Closed surfaces : mm about all that is still to be scanned; None where nothing is."""
    if not seen.unseen.any():
        return None
    field = np.pad(np.where(seen.room, seen.seen, np.float32(1)), 1, constant_values=1)
    vertices, faces, _, _ = marching_cubes(field, WELL, gradient_direction="ascent")  # low within
    places = rigid.apply(insonation.world_from_voxel(seen.where.grid), vertices[:, ::-1] - 1.0)
    return trimesh.Trimesh(places, faces, process=False)


def write(folder: Path, seen: Seen) -> None:
    """Write the map, the table and the surface about what is still to be scanned, in a folder that appears whole."""
    volumes.write_volume(folder / VOLUME, seen.volume)
    (folder / TABLE).write_text(json.dumps(seen.table.model_dump(mode="json"), indent=1) + "\n", encoding="utf-8")
    if (surface := unseen_surface(seen)) is not None:
        meshes.write_ply(folder / SURFACE, surface)


def read(folder: Path) -> SeenFiles | None:
    """Read them from a folder of `sonotwin segment`; None of one that was written before there were any.

    Raises
    ------
    InputError
        If one is damaged.
    """
    path = folder / VOLUME
    if not path.is_file():
        return None
    volumes.read_volume(path)  # a damaged one is refused here, not by who opens a copy
    table = validated(Table, json_text.read(folder / TABLE, "a table of what was seen"), folder / TABLE)
    surface = folder / SURFACE
    return SeenFiles(path, table, meshes.read_ply(surface, "a surface about what wasn't seen") if surface.is_file() else None)
