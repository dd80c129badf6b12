"""Read a DICOM study of results: a volume, masses on its grid, surfaces and measurements.

Reads the folder that `sonotwin export layout=dicom` writes, or others' files by the same names: volume.dcm (Enhanced US Volume),
and as far as they are there masses.dcm (Segmentation), surfaces.dcm (Surface Segmentation) and report.dcm (Comprehensive 3D SR);
uncompressed, and all in the volume's frame of reference. Writes into the folder `out`: volume.nrrd; of each segment a mask,
mass0.nrrd, and of each surface mass0.ply or skin.ply; and metrics.json, the report's figures. `sonotwin fuse` and `sonotwin
project` take volume, masses and skin. All is in the frame of camera 1, mm, where the study has it; of others' studies in the
patient's. Results that are there already are replaced. Takes seconds.

    sonotwin import-results folder=for_archive out=results
"""

import re
from pathlib import Path

import numpy as np

from recon.dicom import study_files
from recon.files import atomic, meshes, metrics, volumes
from recon.files.volumes import Volume
from recon.model.part import Part
from recon.session.volume_step import VOLUME
from sonotwin.console_watch import LineConsole

BY = "import-results"  # who writes


class Config(Part):
    """Fields of `sonotwin import-results`."""

    folder: Path
    """folder with volume.dcm, and masses.dcm, surfaces.dcm, report.dcm if there are such"""
    out: Path
    """folder; gets volume.nrrd, mass0.nrrd, mass0.ply ..., skin.ply, metrics.json"""


def run(config: Config) -> None:
    """Read and write.

    Raises
    ------
    InputError
        If a file is missing or damaged, compressed, of another kind or another frame of reference, or `out` can't be written to.
    """
    console = LineConsole()
    atomic.check_folder(config.out, BY, inputs=[config.folder])
    with console.status("reading"):
        found = study_files.read(config.folder)
    grid = found.volume
    with console.status("writing"), atomic.new_folder(config.out, BY) as folder:
        volumes.write_volume(folder / VOLUME, grid)
        for name, mask in _named(found.masks).items():
            volumes.write_volume(
                folder / f"{name}.nrrd", Volume(mask.astype(np.uint8), grid.origin, grid.spacing, grid.directions)
            )
        for name, mesh in _named(found.surfaces).items():
            meshes.write_ply(folder / f"{name}.ply", mesh)
        figures = {f"{name}_{key}": value for name, one in _named(found.figures).items() for key, value in one.items()}
        metrics.write(folder / metrics.FILE, {"masses": len(found.figures)} | figures)
        written = sorted(path.name for path in folder.iterdir())
    nz, ny, nx = grid.voxels.shape
    console.print(f"volume      {nx}x{ny}x{nz} voxels of {'x'.join(f'{step:.4g}' for step in grid.spacing)} mm", markup=False)
    for what, names in (("masks", found.masks), ("surfaces", found.surfaces), ("measured", found.figures)):
        console.print(f"{what:12}{', '.join(_named(names)) or 'none'}", markup=False)
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def _named(parts: dict) -> dict:
    """Parts by names that files may have: their own, or numbers where those are others."""
    plain = all(re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}", name) and name != Path(VOLUME).stem for name in parts)
    lower = {name.lower() for name in parts}
    return parts if plain and len(lower) == len(parts) else {f"part{k}": part for k, part in enumerate(parts.values())}
