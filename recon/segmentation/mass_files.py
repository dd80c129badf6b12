"""Masses as `sonotwin segment` leaves them: meshes, and the figures of each."""

from dataclasses import dataclass
from pathlib import Path

import trimesh

from recon.capture.images import natural_key
from recon.errors import InputError
from recon.files import meshes, metrics
from recon.files.metrics import Metrics


@dataclass(frozen=True, eq=False)
class FoundMass:
    """A mass and its figures, by their names without that of the mass; none where its folder has none."""

    mesh: trimesh.Trimesh
    figures: Metrics


def read_masses(folder: Path) -> dict[str, FoundMass]:
    """The masses of a folder by name, the largest first; there may be none.

    Raises
    ------
    InputError
        If the folder has neither masses nor figures of `sonotwin segment`, or a mass is damaged.
    """
    paths, told = sorted(folder.glob("mass*.ply"), key=natural_key), folder / metrics.FILE
    if not paths and not told.is_file():
        raise InputError(f"{folder}: expected a folder of `sonotwin segment`, found neither mass0.ply nor {metrics.FILE} in it")
    figures = metrics.read(told) if told.is_file() else {}
    return {path.stem: FoundMass(meshes.read_ply(path, "a mass"), _of(path.stem, figures)) for path in paths}


def _of(name: str, figures: Metrics) -> Metrics:
    return {key.removeprefix(f"{name}_"): value for key, value in figures.items() if key.startswith(f"{name}_")}
