"""The four objects of a study in a folder, written and read back together."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.dicom import enhanced_volume, mass_segments, measurement_report, study_objects, surface_segments
from recon.dicom.patient_fields import Patient
from recon.dicom.study_objects import Results, Study
from recon.files.metrics import Metrics
from recon.files.volumes import Volume
from recon.geometry import rigid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

VOLUME, SEGMENTS, SURFACES, REPORT = "volume.dcm", "masses.dcm", "surfaces.dcm", "report.dcm"


@dataclass(frozen=True, eq=False)
class Received:
    """A study that was read, in the world if its volume has that, else in the patient's frame; empty of what it lacks."""

    volume: Volume
    masks: dict[str, Mask]  # (nz, ny, nx), by the segments' labels
    surfaces: dict[str, trimesh.Trimesh]  # by the segments' labels
    figures: dict[str, Metrics]  # by the masses' names


def write(folder: Path, results: Results, patient: Patient, searched: bool) -> list[str]:
    """Write what there is: the volume, and segments, surfaces and report of the masses; returns lines about it.

    results : in the world
    searched : whether masses were looked for, so that there is a report even if none was found

    Raises
    ------
    InputError
        If the volume's voxels are of a kind that the object doesn't hold, or too many.
    """
    study = Study.of(patient, results)
    patient_from_world = patient.patient_from_world
    turned = results.moved(patient_from_world)
    volume = enhanced_volume.built(study, turned.volume, rigid.invert(patient_from_world))
    study_objects.write(folder / VOLUME, volume)
    nz, ny, nx = turned.volume.voxels.shape
    lines = [f"volume      {nx}x{ny}x{nz} voxels: Enhanced US Volume"]
    masks = {name: mass_segments.rasterised(mass.mesh, turned.volume) for name, mass in turned.masses.items()}
    outside = [name for name, mask in masks.items() if not mask.any()]
    masks = {name: mask for name, mask in masks.items() if name not in outside}
    segments = None
    if masks:
        segments = mass_segments.built(study, volume, turned.volume, masks)
        study_objects.write(folder / SEGMENTS, segments)
        lines.append(f"masses      {', '.join(masks)}: Segmentation, {segments.NumberOfFrames} slices")
    lines += [f"warning     {name} has no voxel of the volume: in surfaces.dcm alone" for name in outside]
    if turned.masses or turned.skin is not None:
        camera = patient_from_world[:3, 3]
        surfaces = surface_segments.built(study, volume, turned.masses, turned.skin, camera)
        study_objects.write(folder / SURFACES, surfaces)
        count = sum(int(one.SurfacePointsSequence[0].NumberOfSurfacePoints) for one in surfaces.SurfaceSequence)
        lines.append(f"surfaces    {surfaces.NumberOfSurfaces} of {count} points in all: Surface Segmentation")
    if searched:
        figures = {name: measurement_report.measured(turned.masses[name]) for name in masks}
        apart = [
            f"{name}, {abs(float(turned.masses[name].mesh.volume)):.0f} mm3, has no voxel of the volume." for name in outside
        ]
        report = measurement_report.built(study, volume, segments, figures, [*turned.remarks, *apart])
        study_objects.write(folder / REPORT, report)
        lines.append(
            f"report      {len(figures)} masses, {len(turned.remarks) + len(outside)} remarks: Comprehensive 3D SR, unverified"
        )
    named = "as the patient's file has them" if patient.identified else f"none: {volume.PatientName}, {volume.PatientID}"
    lines.append(f"patient     {named}; study {volume.StudyInstanceUID}")
    return lines


def read(folder: Path) -> Received:
    """Read a study that `write` wrote, or one with the same names.

    Raises
    ------
    InputError
        If a file is missing or damaged, or they aren't of one frame of reference.
    """
    over = enhanced_volume.read(folder / VOLUME)
    frame, world_from_patient = over.frame_of_reference, over.world_from_patient
    there = {name for name in (SEGMENTS, SURFACES, REPORT) if os.path.lexists(folder / name)}
    masks = mass_segments.read(folder / SEGMENTS, over) if SEGMENTS in there else {}
    surfaces = surface_segments.read(folder / SURFACES, frame) if SURFACES in there else {}
    figures = measurement_report.read(folder / REPORT, frame) if REPORT in there else {}
    return Received(
        study_objects.moved_volume(over.volume, world_from_patient),
        masks,
        {name: study_objects.moved_mesh(mesh, world_from_patient) for name, mesh in surfaces.items()},
        {name: _moved(one, world_from_patient) for name, one in figures.items()},
    )


def _moved(figures: Metrics, to_from: Array) -> Metrics:
    """Figures with the centre in another frame."""
    names = [f"centre_{axis}_mm" for axis in "xyz"]
    if not all(name in figures for name in names):
        return figures
    centre = rigid.apply(to_from, np.array([figures[name] for name in names]))
    return figures | dict(zip(names, centre.tolist(), strict=True))
