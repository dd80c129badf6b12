"""The map of what was seen: where a mass of some size and contrast would have been found, had there been one."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field
from skimage.measure import marching_cubes

from recon.errors import validated
from recon.files import json_text, meshes, volumes
from recon.files.metrics import Metrics
from recon.files.volumes import Volume
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.part import Fraction, NotNegative, Part, Positive
from recon.segmentation import detectability, insonation
from recon.segmentation.detectability import ASSUMED, OBSERVER, Calibration, Sought
from recon.segmentation.insonation import Insonation, Spread

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

VOLUME, SURFACE, TABLE = "seen.nrrd", "unseen.ply", "seen.json"  # files
SIZES_MM, CONTRASTS_DB = (4.0, 6.0, 8.0, 12.0, 20.0), (2.5, 5.0, 8.0, 15.0)  # of the table
WELL, POORLY = 0.9, 0.5  # probability from which a place counts as seen, and below which it counts as unseen


class Table(Part):
    """Shares of what was scanned in which masses would have been found; the content of the file."""

    size_mm: Positive
    """of the mass that the map is for"""
    contrast_db: NotNegative
    """of it"""
    sizes_mm: tuple[Positive, ...] = SIZES_MM
    contrasts_db: tuple[NotNegative, ...] = CONTRASTS_DB
    shares: tuple[tuple[Fraction, ...], ...] = Field(default=())
    """a row a size, a column a contrast"""


@dataclass(frozen=True, eq=False)
class Seen:
    """The map for one mass, and the table for others."""

    where: Insonation
    sought: Sought
    probability: Map  # (nz, ny, nx); 0 where the mass has no room under the skin, and outside of what is to be scanned
    table: Table

    @property
    def room(self) -> Mask:
        """Places (nz, ny, nx) in and beside what was scanned where the mass has room under the skin."""
        return self.where.around & roomy(self.where, self.sought.size_mm)

    @property
    def unseen(self) -> Mask:
        """Places that are still to be scanned : (nz, ny, nx)."""
        return self.room & (self.probability < POORLY)

    @property
    def figures(self) -> Metrics:
        """Figures, each named with its unit."""
        scanned, voxel = self.room & self.where.hull, self.where.voxel_mm3
        return {
            "seen_mm3": float((scanned & (self.probability >= WELL)).sum()) * voxel,
            "unseen_mm3": float((scanned & (self.probability < POORLY)).sum()) * voxel,
        }

    @property
    def line(self) -> str:
        """A line for the console."""
        seen, unseen = (value / 1000 for value in self.figures.values())
        scanned = float((self.room & self.where.hull).sum()) * self.where.voxel_mm3 / 1000
        what = f"a mass of {self.sought.size_mm:g} mm and {self.sought.contrast_db:g} dB"
        return f"seen        {seen:.0f} of {scanned:.0f} cm3 well enough for {what}; {unseen:.0f} cm3 not"

    @property
    def volume(self) -> Volume:
        """The map as a volume."""
        grid = self.where.grid
        return Volume(self.probability, grid.origin, grid.spacing, grid.directions)


@dataclass(frozen=True, eq=False)
class SeenFiles:
    """The map as it lies in a folder of `sonotwin segment`."""

    volume: Path
    table: Table
    unseen: trimesh.Trimesh | None = None  # surface about what is still to be scanned


def roomy(where: Insonation, size_mm: float) -> Mask:
    """Places : (nz, ny, nx) where a ball of a diameter lies below the skin as a whole."""
    return where.under_mm >= size_mm / 2


def probability(where: Insonation, sought: Sought, uneven_db: float, calibration: Calibration = ASSUMED) -> Map:
    """Probability : (nz, ny, nx) that a mass with its middle at each place is found, wherever that is."""
    return next(_probabilities(where, sought.size_mm, [sought], uneven_db, calibration))


def _probabilities(
    where: Insonation, size_mm: float, several: Iterable[Sought], uneven_db: float, calibration: Calibration
) -> Iterator[Map]:
    """The same of several masses of one size."""
    ball = detectability.ball_means(where, size_mm)
    for one in several:
        found = detectability.features(ball, where.elevational_mm, one, uneven_db)
        yield detectability.probability(found, calibration).astype(np.float32)


def look(
    where: Insonation, sought: Sought | None = None, uneven_db: float = OBSERVER.even_db, calibration: Calibration = ASSUMED
) -> Seen:
    """The map for a mass, by how each place was seen, and the table.

    uneven_db : of the tissue's power, as of `recon.segmentation.masses.from_scans`
    """
    chosen = sought or Sought()
    rows = []
    for size in SIZES_MM:
        scanned = where.hull & roomy(where, size)
        several = [Sought(size, contrast, chosen.bright) for contrast in CONTRASTS_DB]
        made = _probabilities(where, size, several, uneven_db, calibration)
        rows.append(tuple(float(one[scanned].mean()) if scanned.any() else 0.0 for one in made))
    there = where.around & roomy(where, chosen.size_mm)
    found = np.where(there, probability(where, chosen, uneven_db, calibration), np.float32(0))
    return Seen(where, chosen, found, Table(size_mm=chosen.size_mm, contrast_db=chosen.contrast_db, shares=tuple(rows)))


def of_scans(
    scans: Scans,
    skin: trimesh.Trimesh | None = None,
    spread: Spread | None = None,
    sought: Sought | None = None,
    uneven_db: float = OBSERVER.even_db,
) -> Seen:
    """The map of a sweep's B-scans; see `look` and `recon.segmentation.insonation.of_sweep`, which raises InputError."""
    face_row = 0.0 if scans.probe is None else scans.probe.face_row
    where = insonation.of_sweep(scans.world_from_pixel, scans.shape, scans.stream(), skin, spread, face_row)
    return look(where, sought, uneven_db)


def unseen_surface(seen: Seen) -> trimesh.Trimesh | None:
    """Closed surfaces : mm about all that is still to be scanned; None where nothing is."""
    if not seen.unseen.any():
        return None
    field = np.pad(np.where(seen.room, seen.probability, np.float32(1)), 1, constant_values=1)
    vertices, faces, _, _ = marching_cubes(field, POORLY, gradient_direction="ascent")  # low within
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
