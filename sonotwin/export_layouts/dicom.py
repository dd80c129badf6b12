"""Results as a DICOM study for a hospital's archive: volume, segmentation, surfaces and report, without names unless given."""

from pathlib import Path

import trimesh

from recon.dicom import patient_fields, study_files
from recon.dicom.patient_fields import Patient
from recon.dicom.study_objects import Results
from recon.errors import InputError
from recon.files import meshes, metrics, volumes
from recon.fusion import skin
from recon.segmentation import left_out, mass_files
from recon.segmentation.mass_files import FoundMass
from recon.session.volume_step import VOLUME
from sonotwin.export_layouts import Settings

TAKES = ("volume", "masses", "surface", "patient")
ABOUT = "of results: volume, masses and surface"
SURFACE = "surface.ply"


def write(folder: Path, settings: Settings) -> list[str]:
    """Write the study.

    Raises
    ------
    InputError
        If no volume is given, or a file is missing or damaged.
    """
    if settings.volume is None:
        raise InputError("export: volume: needs a value with layout=dicom; give volume=FOLDER of `sonotwin freehand`")
    volume = volumes.read_volume(settings.volume / VOLUME if settings.volume.is_dir() else settings.volume)
    patient = Patient() if settings.patient is None else patient_fields.read(settings.patient)
    masses, remarks = ({}, []) if settings.masses is None else _searched(settings.masses)
    surface = None if settings.surface is None else _surface(settings.surface)
    lines = study_files.write(folder, Results(volume, masses, surface, remarks), patient, settings.masses is not None)
    if settings.patient is None or "axes" not in patient.model_fields_set:
        x, y, z = patient.axes
        given = f"x of the world is taken to point {x}, y {y}, z {z}"
        lines.append(f"warning     axes: {given}; give a patient's file with axes: [...], or left and right may be wrong")
    return lines


def _searched(folder: Path) -> tuple[dict[str, FoundMass], list[str]]:
    """Masses of a search, and remarks on it."""
    masses = mass_files.read_masses(folder)
    figures = metrics.read(folder / metrics.FILE) if (folder / metrics.FILE).is_file() else {}
    missing = left_out.read(folder / left_out.FILE)
    remarks = [f"Masses were looked for: {len(masses) or 'none'} {'was' if len(masses) < 2 else 'were'} measured."]
    if (seen := figures.get("seen_probability")) is not None and seen == seen:
        remarks.append(
            f"Within what was scanned a mass of usual size and contrast would have been found with {100 * seen:.0f} %."
        )
    if (undone := figures.get("undone_most_mm", 0.0)) > 0:
        moved = f"by up to {undone:.1f} mm, the volume isn't"
        remarks.append(
            f"Masses are those of the body at rest: B-scans were put back {moved}, so masses may lie beside what it shows."
        )
    listed = [one.text for one in missing if one.reason not in left_out.UNLIKELY]
    return masses, [*remarks, *(f"Not measured, place in the frame of camera 1: {text}" for text in listed)]


def _surface(path: Path) -> trimesh.Trimesh:
    """The skin: that of a folder without the table, or a file as it is."""
    if not path.is_dir():
        return meshes.read_ply(path, "a surface")
    surface = meshes.read_ply(path / SURFACE, "a surface")
    return skin.by_plane(surface).skin or surface
