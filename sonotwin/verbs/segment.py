"""Find masses, or a tube, in the B-scans of a freehand sweep, as closed surfaces in the world.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker, or a tracked
sequence of the PLUS toolkit; and the skin as of `sonotwin surface`, a PLY, to check that masses lie inside, or to fit the round
body about a tube, with the wall between both. Writes into the folder `out`: mass0.ply, mass1.ply ... from the largest on, or
tube.ply and cover.ply, in the world's frame, mm; the same as .glb; some B-scans with the outline, overlay0.png ...; and
metrics.json. Results that are there already are replaced. Takes a quarter of a minute for 150 B-scans, a tube some seconds.

    sonotwin segment capture=outputs/sweep/capture lag_s=0.05 tissue_m_s=1450 out=outputs/masses
    sonotwin segment capture=outputs/sweep/capture lag_s=0.05 surface=outputs/surface/surface.ply out=outputs/masses
    sonotwin segment kind=tube capture=outputs/tank/capture probe=outputs/probe/probe.yaml lag_s=0.05 out=outputs/tube
"""

from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import cv2
import trimesh
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from rich.console import Console

from recon.capture import sweep_part
from recon.errors import InputError
from recon.files import atomic, meshes, metrics
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Scans, Unsure
from recon.model.probe import SCANNER_SPEED, Speed, SpeedSigma
from recon.model.rig import NotNegative, Positive
from recon.model.tracks import LagSeconds
from recon.segmentation import containment, segmented_scans
from recon.segmentation.blur_correction import MOST_MM, Blur
from recon.segmentation.echo_power import SLICE_MM, SPREAD_MM
from recon.segmentation.segmented_scans import Segmented
from recon.segmentation.tube_wall import Appearance

Spread = Annotated[float, Field(ge=0, le=MOST_MM)]
Spreads = tuple[Spread, Spread]  # along the array and in depth


def _rising(value: tuple[tuple[float, float], ...] | None) -> tuple[tuple[float, float], ...] | None:
    depths = [depth for depth, _ in value or ()]
    if any(second <= first for first, second in pairwise(depths)):
        raise ValueError(f"expected rising depths, found {depths}")
    return value


Slice = Annotated[tuple[tuple[NotNegative, Spread], ...] | None, AfterValidator(_rising)]  # depths, and across the plane there


class Config(BaseModel):
    """Fields of `conf/segment.yaml`."""

    model_config = ConfigDict(extra="forbid")

    out: Path
    kind: Literal["masses", "tube"] = "masses"
    capture: Path | None = None
    sweep: str = ""
    probe: Path | None = None
    lag_s: LagSeconds = 0.0
    lag_sigma_s: NotNegative = 0.0
    sequence: Path | None = None
    surface: Path | None = None
    tissue_m_s: Speed | None = None
    tissue_sigma_m_s: SpeedSigma = 25.0
    mass_m_s: Speed = SCANNER_SPEED
    mass_sigma_m_s: SpeedSigma = 20.0
    dynamic_range_db: Annotated[float, Field(ge=20, le=120)] = 60.0
    diameter_mm: tuple[Positive, Positive] = (5.0, 36.0)
    spread_mm: Spreads = SPREAD_MM
    slice_mm: Slice = SLICE_MM
    min_contrast_db: Annotated[float, Field(ge=0, le=120)] = 15.0
    top_mm: Annotated[float, Field(ge=0, le=100)] = 2.5
    overlays: Annotated[int, Field(ge=0, le=100)] = segmented_scans.OVERLAYS

    @model_validator(mode="after")
    def _one_source(self) -> "Config":
        if (self.capture is None) == (self.sequence is None):
            raise ValueError(f"expected capture or sequence, found {'neither' if self.capture is None else 'both'}")
        for name, value in (("lag_s", self.lag_s), ("lag_sigma_s", self.lag_sigma_s)):
            if self.sequence is not None and value != 0:
                raise ValueError(f"{name}: expected none with a sequence, whose poses are those of its images, found {value:g}")
        if self.diameter_mm[0] >= self.diameter_mm[1]:
            raise ValueError(f"diameter_mm: expected the least before the most, found {list(self.diameter_mm)}")
        return self

    @property
    def blur(self) -> Blur | None:
        """Blur of the B-scans that masses are corrected for."""
        return None if self.slice_mm is None else Blur(self.spread_mm[0], self.slice_mm)

    @property
    def tube(self) -> Appearance:
        """Appearance of a tube."""
        return Appearance(self.diameter_mm, self.spread_mm, self.dynamic_range_db, self.min_contrast_db, self.top_mm)


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
    skin = None if config.surface is None else containment.read_skin(config.surface)
    scans = read(config)
    console.print(f"read        {freehand_scans.summary(scans)}", markup=False)
    console.print(f"depth       {freehand_scans.depths(scans)}", markup=False)
    start = perf_counter()
    with console.status(f"looking for {'a tube' if config.kind == 'tube' else 'masses'}"):
        found = found_in(scans, config, skin)
    for line in found.lines:
        console.print(line, markup=False)
    figures = {"frames": len(scans.world_from_pixel), "frames_placed": scans.placed, "speed_m_per_s": scans.speed_m_s}
    with console.status("writing"), atomic.new_folder(config.out, metrics.FILE) as folder:
        for name, mesh in found.meshes.items():
            meshes.write_ply(folder / f"{name}.ply", mesh)
            meshes.write_glb(folder / f"{name}.glb", mesh)
        for number, image in enumerate(found.overlays):
            (folder / f"overlay{number}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
        metrics.write(folder / metrics.FILE, figures | found.figures | {"seconds_segment": round(perf_counter() - start, 3)})
        written = sorted(path.name for path in folder.iterdir())
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def read(config: Config) -> Scans:
    """The B-scans in the world."""
    if config.capture is None:
        assert config.sequence is not None
        return freehand_scans.of_sequence(config.sequence, config.probe, None, config.tissue_m_s)
    sweep = sweep_part.read_sweep(config.capture, config.sweep, "volume")
    probe = freehand_scans.probe_of(sweep, config.capture, config.probe)
    unsure = Unsure(config.lag_sigma_s, config.tissue_sigma_m_s)
    return freehand_scans.of_sweep(sweep, probe, config.lag_s, config.tissue_m_s, unsure)


def found_in(scans: Scans, config: Config, skin: trimesh.Trimesh | None) -> Segmented:
    """The masses, or the tube; a fault's message starts with its source."""
    try:
        if config.kind == "tube":
            return segmented_scans.find_tube(scans, config.tube, config.overlays, skin)
        sigmas = config.tissue_sigma_m_s, config.mass_sigma_m_s
        return segmented_scans.find_masses(
            scans, skin, config.mass_m_s, config.dynamic_range_db, config.overlays, sigmas, config.blur
        )
    except InputError as error:
        source = str(config.capture or config.sequence)
        raise error if str(error).startswith(source) else InputError(f"{source}: {error}") from None
