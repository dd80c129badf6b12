"""Find masses, or a tube, in the B-scans of a freehand sweep, as closed surfaces in the world.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker, or a tracked
sequence of the PLUS toolkit; and the skin as of `sonotwin surface`, a PLY, to check that masses lie inside, or to fit the round
body about a tube, with the wall between both. Writes into the folder `out`: mass0.ply, mass1.ply ... from the largest on, or
tube.ply and cover.ply, in the world's frame, mm; the same as .glb; some B-scans with the outline, overlay0.png ...; and
metrics.json. Results that are there already are replaced. Takes a quarter of a minute for 150 B-scans, a tube some seconds.

    sonotwin segment capture=outputs/sweep/capture lag_s=0.05 tissue_m_s=1450 out=outputs/masses
    sonotwin segment capture=outputs/sweep/capture lag_s=0.05 surface=outputs/surface/surface.ply out=outputs/masses
    sonotwin segment sequence=sweep.igs.mha config=config.xml clip=[120,80,400,500] slice_mm=null out=outputs/masses
    sonotwin segment kind=tube capture=outputs/tank/capture probe=outputs/probe/probe.yaml lag_s=0.05 out=outputs/tube
"""

from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import cv2
import trimesh
from pydantic import AfterValidator, Field, model_validator
from rich.console import Console

from recon.capture import probe_files, sweep_part
from recon.errors import InputError
from recon.files import atomic, meshes, metrics
from recon.freehand import plus_config
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Scans, ScansFields
from recon.freehand.sequences import FrameNames
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.model.probe import SCANNER_SPEED, Speed, SpeedSigma
from recon.model.rig import NotNegative, Positive
from recon.segmentation import containment, segmented_scans
from recon.segmentation.blur_correction import MOST_MM, Blur
from recon.segmentation.echo_power import SLICE_MM, SPREAD_MM
from recon.segmentation.segmented_scans import Segmented
from recon.segmentation.tube_wall import Appearance

Spread = Annotated[float, Field(gt=0, le=MOST_MM)]
Spreads = tuple[Spread, Spread]  # along the array and in depth


def _rising(value: tuple[tuple[float, float], ...] | None) -> tuple[tuple[float, float], ...] | None:
    depths = [depth for depth, _ in value or ()]
    if any(second <= first for first, second in pairwise(depths)):
        raise ValueError(f"expected rising depths, found {depths}")
    return value


Slice = Annotated[tuple[tuple[NotNegative, Spread], ...] | None, AfterValidator(_rising)]  # depths, and across the plane there


class Config(ScansFields):
    """Fields of `sonotwin segment`."""

    out: Path
    """folder; gets mass0.ply ... or tube.ply and cover.ply, the same as .glb, overlays of some B-scans, metrics.json"""
    kind: Literal["masses", "tube"] = "masses"
    """what is looked for: masses, darker than the tissue around them; tube, round, in water"""
    clip: Rectangle | None = None
    """[u, v, width, height] px, the part of each B-scan that is looked at, of an uncropped screen; null is the
    configuration's, or else all of it"""
    surface: Path | None = None
    """the skin, as of `sonotwin surface`, a .ply: says whether each mass lies inside, and how deep; with kind=tube the round
    body about the tube, of which diameter and wall are measured"""
    mass_m_s: Speed = SCANNER_SPEED
    """m/s in the masses: 1510 to 1570 in those of the breast"""
    mass_sigma_m_s: SpeedSigma = 20.0
    """m/s, standard deviation of the former, of which their volumes are uncertain"""
    dynamic_range_db: Annotated[float, Field(ge=20, le=120)] = 60.0
    """dB from black to white, as set on the scanner"""
    diameter_mm: tuple[Positive, Positive] = (5.0, 36.0)
    """mm, least and most, of a tube"""
    spread_mm: Spreads = SPREAD_MM
    """mm, sigma of an echo's power along the array and in depth; both move a tube's bent wall, the first flattens masses'
    lobes and blurs their shadows. These are the default array's. To measure them: the half-maximum width of a thin wire's
    echo amplitude there, over 2.355 * sqrt(2)"""
    slice_mm: Slice = SLICE_MM
    """mm, depth and sigma of an echo's power across the image plane there, which flattens masses' lobes; these are the default
    array's. To measure it: the half-maximum width, across the plane, of the echo amplitude of a thin wire or of an inclined
    sheet (IEC 61391-1) at some depths, over 2.355 * sqrt(2). [] takes an infinitely thin slice, and null leaves lobes as
    flat as they are found, and edges of shadows sharp"""
    min_contrast_db: Annotated[float, Field(ge=0, le=120)] = 15.0
    """dB, of a tube's wall above the water"""
    top_mm: Annotated[float, Field(ge=0, le=100)] = 2.5
    """mm of ringing at the probe's face, left out when a tube is looked for"""
    overlays: Annotated[int, Field(ge=0, le=100)] = segmented_scans.OVERLAYS
    """B-scans that are drawn with the outline"""

    @model_validator(mode="after")
    def _in_order(self) -> "Config":
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
    sources = (config.capture, config.probe, config.sequence, config.tracker, config.config, config.surface)
    inputs = [path for path in sources if path is not None]
    atomic.check_folder(config.out, "segment", inputs=inputs)
    skin = None if config.surface is None else containment.read_skin(config.surface)
    scans = freehand_scans.in_memory(read(config))  # what follows reads them some times more
    freehand_scans.check_size(scans, str(config.capture or config.sequence), None, config.implausible)
    console.print(f"read        {freehand_scans.summary(scans)}", markup=False)
    console.print(f"depth       {freehand_scans.depths(scans)}", markup=False)
    for line in config.assumptions(scans.speed_m_s, scans.poses_exact):
        console.print(f"assumed     {line}", markup=False)
    for line in freehand_scans.cautions(scans):
        console.print(f"warning     {line}", markup=False)
    start = perf_counter()
    with console.status(f"looking for {'a tube' if config.kind == 'tube' else 'masses'}"):
        found = found_in(scans, config, skin)
    for line in found.lines:
        console.print(line, markup=False)
    figures = {
        "frames": len(scans.world_from_pixel),
        "frames_placed": scans.placed,
        "poses_left_out": scans.left_out,
        "speed_m_per_s": scans.speed_m_s,
    }
    with console.status("writing"), atomic.new_folder(config.out, "segment") as folder:
        for name, mesh in found.meshes.items():
            meshes.write_ply(folder / f"{name}.ply", mesh)
            meshes.write_glb(folder / f"{name}.glb", mesh)
        for number, image in enumerate(found.overlays):
            (folder / f"overlay{number}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
        metrics.write(folder / metrics.FILE, figures | found.figures | {"seconds_segment": round(perf_counter() - start, 3)})
        written = sorted(path.name for path in folder.iterdir())
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def read(config: Config) -> Scans:
    """The B-scans in the world, or the parts of them within the clip."""
    if config.sequence is not None:
        return read_sequence(config, config.sequence)
    assert config.capture is not None
    sweep = sweep_part.read_sweep(config.capture, config.sweep, "volume", config.implausible)
    probe = freehand_scans.probe_of(sweep, config.capture, config.probe)
    scans = freehand_scans.of_sweep(sweep, probe, config.lag, config.tissue_m_s, config.unsure)
    return scans if config.clip is None else freehand_scans.cut(scans, Clip(*config.clip))


def read_sequence(config: Config, path: Path) -> Scans:
    """The B-scans of a sequence in its reference frame, or the parts of them within the clip."""
    plus = None if config.config is None else plus_config.read_config(config.config)
    if plus is not None and plus.volume is not None and plus.volume.fan is not None and config.clip is None:
        expected = "none, as masses are sought in rectangles; give clip=[u,v,width,height] within it"
        raise InputError(f"{config.config}: FanAnglesDeg: expected {expected}, found a fan")
    names = config.frame_names(FrameNames() if plus is None else plus.names)
    probe = None if config.probe is None else probe_files.read(config.probe)
    fixed = {} if plus is None else plus.transforms
    scans = freehand_scans.of_sequence(
        path, names, probe, fixed, config.lag, config.tissue_m_s, config.tracker, config.implausible
    )
    clip = Clip(*config.clip) if config.clip is not None else None if plus is None or plus.volume is None else plus.volume.clip
    return scans if clip is None else freehand_scans.cut(scans, clip)


def found_in(scans: Scans, config: Config, skin: trimesh.Trimesh | None) -> Segmented:
    """The masses, or the tube; a fault's message starts with its source."""
    try:
        if config.kind == "tube":
            return segmented_scans.find_tube(scans, config.tube, config.overlays, skin)
        sigmas = config.unsure.tissue_m_s, config.mass_sigma_m_s
        return segmented_scans.find_masses(
            scans, skin, config.mass_m_s, config.dynamic_range_db, config.overlays, sigmas, config.blur
        )
    except InputError as error:
        source = str(config.capture or config.sequence)
        raise error if str(error).startswith(source) else InputError(f"{source}: {error}") from None
