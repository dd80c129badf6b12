"""Write a capture in another group's layout, for their programs.

A program's name, such as `layout=kalibr`, `ros`, `mrcal` or `slstudio`, is for the calibration of cameras and projector alone, of
a capture or as a file: Kalibr's camchain.yaml, ROS's camera_info and mrcal's cameramodel with a file a device, SLStudio's
calibration.xml. `layout=meza2021` is that of the rig's authors: SLdata/images and mask.png, USdata/L, R, US and USmasks with
target_pose.npy, and the files of all calibrations, US_params.npz for a chosen speed of sound. `layout=us_calibration` is for
their calibration of the probe: data1, data2, ... of a capture each, with L, R, UScrop, target_pose.npy, and cross_point.npy of
the crossings found, beside cam1_cam2.npz and their config.yaml. The pose is that of the frames in L/ and R/, taken a little
before or after the B-scan; `frames=false` writes B-scans alone, each with its own pose. `layout=markerpose` is for the training
of their networks: of data sets, data_centers.csv with images/, patch120/ and mask120/; and for their example: of a film,
images/L, R and StereoParams.xml. Reads a capture folder, of a sweep with poses, as `sonotwin track` and `sonotwin reconstruct`
leave it, and results of other verbs for what a capture doesn't hold. B-scans without a pose are left out. Writes into the folder
`out`; an earlier export there is replaced whole, and nothing else ever is. Takes seconds.

    sonotwin export capture=session/capture out=dataset
    sonotwin export layout=kalibr calibration=optics.yaml out=for_kalibr
    sonotwin export capture=result/poses/scan probe=result/probe/probe.yaml lag_s=0.05 tissue_m_s=1450 out=dataset
    sonotwin export capture=result/poses/scan surface=result/surface masses=result/masses/scan lag_s=0.05 out=dataset
    sonotwin export layout=us_calibration capture=[first/poses/wires,second/poses/wires] out=for_their_calibration
    sonotwin export layout=markerpose data=outputs/data out=for_their_training
    sonotwin export layout=markerpose capture=outputs/film/capture networks=[detector,segmenter] out=for_their_example
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field, PlainValidator
from rich.console import Console

from recon import registry
from recon.capture import (
    calibration_files,
    manifest,
    meza2021_sweep,
    paired_scans,
    probe_files,
    stereo_frames,
    surface_part,
    sweep_part,
)
from recon.capture.layouts import markerpose, meza2021, us_calibration
from recon.capture.manifest import CAMERAS, MANIFEST, Purpose
from recon.capture.paired_scans import PairedScans
from recon.capture.sweep_part import SweepCapture
from recon.errors import Implausible, InputError
from recon.files import atomic, npz
from recon.freehand import scans as freehand_scans
from recon.model.calibration import Calibration
from recon.model.probe import Speed
from recon.model.rig import Part, Positive
from recon.model.tracks import LagSeconds
from recon.probe_calibration import sound_in_water
from recon.segmentation import mass_files
from recon.segmentation.scan_masks import mask_of
from recon.session import probe_step
from recon.session.skin_step import POINTS
from sonotwin.console_watch import LineConsole
from sonotwin.folder_lists import Folders
from trainers import data_sets, markerpose_layout, shard_reader

MEZA, SETS, MARKERPOSE = "meza2021", "us_calibration", "markerpose"

# files of networks, as the scripts load them
Networks = Mapping[Literal["published_detector", "published_segmenter"], str]
MEZA_NETWORKS: Networks = {"published_detector": "superpoint.pt", "published_segmenter": "ellipsegnet.pt"}
MARKERPOSE_NETWORKS: Networks = {"published_detector": "py_superpoint.pt", "published_segmenter": "py_ellipsegnet.pt"}


def known_layout(name: object) -> object:
    """The name of a layout of whole captures, or of a dialect of cameras that is written; else a refusal."""
    return registry.one_of(name, [MEZA, SETS, MARKERPOSE, *calibration_files.written()])


class Config(Part):
    """Fields of `sonotwin export`."""

    layout: Annotated[str, PlainValidator(known_layout)] = MEZA
    """meza2021: the rig authors' data sets; us_calibration: sets for their calibration of the probe; markerpose: their networks'
    training data, and their example's; a program's name, such as kalibr, ros, mrcal, slstudio: the calibration of cameras and
    projector alone"""
    capture: Folders = Field(default=[])
    """a capture folder, which meza2021 needs; of a sweep one with poses, as `sonotwin track` leaves it. us_calibration takes
    several, a set each: [first,second]"""
    out: Path
    """folder; gets SLdata/, USdata/ and the files of calibrations, as far as the capture has them"""
    calibration: Path | None = None
    """file: cameras and projector, in place of the capture's own; enough for a calibration alone"""
    surface: Path | None = None
    """folder of `sonotwin surface`, whose points make the mask; null takes all pixels"""
    sweep: str = ""
    """its name, of a capture that holds several; "" takes the only one for the volume, or for the probe of us_calibration"""
    implausible: Implausible = "refuse"
    """poses that no hand makes: refuse leaves them out, and refuses if they are many; take uses all of them"""
    probe: Path | None = None
    """file: the probe's calibration, in place of the capture's own"""
    lag_s: LagSeconds = 0.0
    """s, delay of the B-scans' time stamps, as of `sonotwin measure-lag`"""
    frames: bool = True
    """also write L/ and R/, where the capture has frames, and the pose as these were taken; false writes B-scans alone, each with
    the pose as it was taken"""
    apart_s: Positive | None = None
    """s, most between a B-scan and its frames; B-scans without nearer ones are left out. null takes the nearest"""
    tissue_m_s: Speed | None = None
    """m/s, of sound for which US_params.npz is to be right; null leaves it as the probe is calibrated"""
    masses: Path | None = None
    """folder of `sonotwin segment`, whose masses make USmasks/; null writes none"""
    data: Folders = Field(default=[])
    """data sets of `sonotwin dataset`, one or several, for markerpose"""
    networks: Folders = Field(default=[])
    """folders with detector.pt and segmenter.pt of the published shape, as of `sonotwin train network=published_detector`; they
    go out by the names that the scripts load"""

    @property
    def source(self) -> Path:
        """The only capture; InputError if none is given, or several."""
        if not self.capture:
            raise InputError("export: capture: needs a value; give capture=...")
        if len(self.capture) > 1:
            raise InputError(f"export: capture: expected one with layout={self.layout}, found {len(self.capture)}")
        return self.capture[0]


def run(config: Config) -> None:
    """Read the parts, and write them as far as the layout has a place for them.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, has nothing for the layout, or `out` can't be written to.
    """
    console = LineConsole()
    given = (*config.capture, config.calibration, config.surface, config.probe, config.masses, *config.data, *config.networks)
    atomic.check_folder(config.out, "export", inputs=given)
    written = []
    if config.layout in (SETS, MARKERPOSE):
        (export_sets if config.layout == SETS else export_markerpose)(config, console)
        return
    if config.layout != MEZA:
        export_cameras(config, console)
        return
    refuse_others(config, ("data",), "of captures alone; layout=markerpose takes data sets")
    held = manifest.read_manifest(config.source)
    with console.status("writing"), meza2021.new_folder(config.out) as folder:
        if held.surface is not None and "cam1" in held.surface.images:
            written += [write_surface(folder, config)]
        elif config.surface is not None:
            written += [f"left out    the mask by {config.surface}: the capture has no fringe images of cam1"]
        if held.sweep is not None or held.sweeps:
            written += write_sweep(folder, config)
        written += write_optics(folder, config)
        written += write_networks(folder, config, MEZA_NETWORKS)
        if not written:
            raise InputError(f"{config.source / MANIFEST}: expected a surface of cam1, a sweep or a calibration, found none")
    for line in written:
        console.print(line, markup=False)
    console.print(f"wrote       {config.out}", markup=False)


def export_sets(config: Config, console: Console) -> None:
    """Write a set for US-Calibration of each capture's sweep over crossed wires, with the crossings that are found.

    Raises
    ------
    InputError
        If there is none, a set has no B-scan with a pose, or sizes differ; or if fields are given that aren't for it.
    """
    refuse_others(config, ("surface", "probe", "tissue_m_s", "masses", "data", "networks"), "of crossed wires alone")
    if not config.capture:
        raise InputError("export: capture: needs a value; give capture=...")
    sizes = set()
    with console.status("writing"), atomic.new_folder(config.out, "export") as folder:
        lines = []
        for number, capture in enumerate(config.capture, 1):
            sweep = sweep_part.read_sweep(capture, config.sweep, "probe", config.implausible)
            sizes.add(sweep.size)
            if len(sizes) > 1:
                expected, there = ("x".join(map(str, size)) for size in ((sizes - {sweep.size}).pop(), sweep.size))
                raise InputError(f"{capture}: expected B-scans of {expected} px, as of {config.capture[0]}, found {there}")
            frames = probe_step.look(sweep, lag_s=config.lag_s)
            selected, about = select(sweep, capture, config, "probe")
            crossings = np.array([frames.seen[k].pixel for k in selected.scans.tolist()])
            found = np.isin(selected.scans, frames.usable)
            kept = selected.chosen(found) if found.any() else selected
            name = us_calibration.write_set(folder, number, kept.images(), kept.poses, crossings[found] if found.any() else None)
            crossed = (
                f"{found.sum()} with a crossing, which alone count"
                if found.any()
                else "none with a crossing: PointSegment.py sets it"
            )
            lines += [f"{name:11} {about[0]}; {crossed}", *about[1:]]
        optics = calibration_files.of_capture(config.capture[0], config.calibration)
        lines.append(f"beside      {', '.join(us_calibration.write_settings(folder, sizes.pop(), optics))}")
    for line in lines:
        console.print(line, markup=False)
    console.print(f"wrote       {config.out}", markup=False)


def export_markerpose(config: Config, console: Console) -> None:
    """Write a data set's views and patches for MarkerPose's training, a film's frames for its example, and networks, as given.

    Raises
    ------
    InputError
        If nothing is given, or a source is damaged or has nothing for it; or if fields are given that aren't for it.
    """
    others = ("surface", "probe", "lag_s", "frames", "apart_s", "tissue_m_s", "masses")
    refuse_others(config, others, "of frames and networks alone")
    if not (config.data or config.capture or config.networks):
        raise InputError("export: data: needs a value with layout=markerpose, or capture or networks does; give data=...")
    lines = []
    with console.status("writing"), atomic.new_folder(config.out, "export") as folder:
        if config.data:
            views = data_sets.read_views(config.data)
            lines.append(f"views       {markerpose_layout.write_views(folder, views)} of {len(views)}, those with all circles")
            if shard_reader.has_patches(config.data):
                patches = data_sets.read_patches(config.data)
                lines.append(
                    f"patches     {markerpose_layout.write_patches(folder, patches)} of {len(patches)}, those with a disc"
                )
            else:
                lines.append("left out    patches: the data set has none, which frames=views writes")
        if config.capture:
            film = stereo_frames.read_film(config.source, config.calibration, config.sweep)
            optics = Calibration(dict(zip(CAMERAS, film.cameras, strict=True)))
            lines.append(
                f"frames      {markerpose.write_film(folder, film.pairs(), film.depths, optics)} pairs, {markerpose.PARAMETERS}"
            )
        lines += write_networks(folder, config, MARKERPOSE_NETWORKS)
    for line in lines:
        console.print(line, markup=False)
    console.print(f"wrote       {config.out}", markup=False)


def export_cameras(config: Config, console: Console) -> None:
    """Write a calibration of cameras for another program.

    Raises
    ------
    InputError
        If there is none, or one that the layout can't say; or if fields are given that aren't for it.
    """
    others = ("surface", "sweep", "probe", "lag_s", "frames", "apart_s", "tissue_m_s", "masses", "data", "networks")
    refuse_others(config, others, "for the calibration of cameras alone")
    if config.capture:
        optics = calibration_files.of_capture(config.source, config.calibration)
    else:
        optics = None if config.calibration is None else calibration_files.read(config.calibration)
    if optics is None:
        raise InputError(f"export: calibration: expected one of cameras for layout={config.layout}, found none")
    dialect = registry.kind(calibration_files.DIALECTS, config.layout)
    with atomic.new_folder(config.out, "export") as folder:
        names = dialect.write(folder, optics)
    devices = dialect.taken(optics)
    console.print(f"optics      {', '.join(devices)}: {', '.join(names)}", markup=False)
    lost = [name for name in optics.cameras if name not in devices] + ["the covariance"] * (optics.uncertainty is not None)
    if lost:
        console.print(f"left out    {', '.join(lost)}: the layout has no place for it", markup=False)
    console.print(f"wrote       {config.out}", markup=False)


def refuse_others(config: Config, names: Sequence[str], what: str) -> None:
    """Refuse fields that a layout doesn't take; `what` it is."""
    for name in names:
        if (value := getattr(config, name)) != Config.model_fields[name].default:
            raise InputError(f"export: {name}: expected none with layout={config.layout}, which is {what}, found {value}")


def write_surface(folder: Path, config: Config) -> str:
    """Write the fringe images and the mask; returns a line about them."""
    surface = surface_part.read_surface(config.source, "cam1", config.calibration)
    if not meza2021.is_theirs(surface):
        return "left out    surface: expected 8 bits, a centre line and 8 fringes of 12 px, whose shifts are numbered from one"
    mask = np.ones(surface.images.shape[1:], bool)
    if config.surface is not None:
        shape = (*mask.shape, 3)
        path = config.surface / POINTS
        mask = np.isfinite(npz.read(path, {"points": npz.Form("f", shape)})["points"]).all(axis=-1)
        if not mask.any():
            raise InputError(f"{path}: points: expected the point of some pixels, found none: no surface was found there?")
    meza2021.write(folder, surface, mask)
    return f"surface     {len(surface.images)} images, {100 * mask.mean():.1f} % of the pixels in the mask"


def write_sweep(folder: Path, config: Config) -> list[str]:
    """Write the B-scans with their poses, frames and masks, and the probe's file; returns lines about them."""
    sweep = sweep_part.read_sweep(config.source, config.sweep, "volume", config.implausible)
    selected, about = select(sweep, config.source, config, "volume")
    lines = [f"sweep       {about[0]}", *about[1:]]
    masks: Iterator[NDArray[np.uint8]] = iter(())
    probe = None if config.probe is None and sweep.probe is None else freehand_scans.probe_of(sweep, config.source, config.probe)
    if probe is not None:
        converted = sound_in_water.for_tissue(probe, config.tissue_m_s)
        probe_files.write_authors(folder / probe_files.AUTHORS, converted)
        meza2021.mark(folder, converted.speed_m_s)
        lines.append(f"probe       {probe_files.AUTHORS}, right for sound of {converted.speed_m_s:.0f} m/s")
    if config.masses is not None and probe is not None:
        scans = freehand_scans.of_sweep(sweep, probe, config.lag_s, config.tissue_m_s)
        meshes = [mass.mesh for mass in mass_files.read_masses(config.masses).values()]
        masks = _masks(meshes, scans.world_from_pixel[selected.scans], sweep.size)
    elif config.masses is not None:
        raise InputError(f"{config.masses}: expected probe, the calibration by which masses lie in B-scans, found none")
    meza2021_sweep.write_sweep(folder / meza2021_sweep.FOLDER, selected.images(), masks, selected.poses)
    return lines


def select(sweep: SweepCapture, capture: Path, config: Config, purpose: Purpose) -> tuple[PairedScans, list[str]]:
    """The B-scans that are written, with the frames nearest to each where these are, and lines about them."""
    place, part = manifest.read_manifest(capture).sweep_of(capture / MANIFEST, "a sweep", config.sweep, purpose)
    if not config.frames or not set(CAMERAS) <= part.images.keys():
        selected = paired_scans.alone(sweep, config.lag_s)
        return selected, [f"{len(selected.scans)} of {len(sweep.paths)} B-scans, those with a pose"]
    film = stereo_frames.read_film(capture, config.calibration, place.partition("/")[2])
    paired = paired_scans.pair(sweep, film, config.lag_s, config.apart_s)
    apart, moved = 1e3 * np.abs(paired.apart_s), paired.moved_mm
    return paired, [
        f"{len(paired.scans)} of {len(sweep.paths)} B-scans, those with a pose, and the frames nearest to each",
        f"pose        that of the frames, {np.median(apart):.3g} ms from their B-scans (median; {apart.max():.3g} at most), in "
        f"which the target moved by {np.median(moved):.2g} mm ({moved.max():.2g} at most); frames=false gives the B-scans' own",
    ]


def write_networks(folder: Path, config: Config, names: Networks) -> list[str]:
    """Write the networks by other names, after a check of their shape; returns a line about them."""
    if not config.networks:
        return []
    from trainers import export  # torch takes seconds to import

    for network, name in names.items():
        file = f"{network.removeprefix('published_')}.pt"
        places = [path for place in config.networks if (path := place / file).exists()]
        if len(places) != 1:
            there = ", ".join(map(str, config.networks))
            raise InputError(f"export: networks: expected {file} in one folder of {there}, found it in {len(places)}")
        export.copy_published(places[0], folder / name, network)
    return [f"networks    {', '.join(names.values())}"]


def write_optics(folder: Path, config: Config) -> list[str]:
    """Write the files of all pairs of cameras; returns a line about them."""
    optics = calibration_files.of_capture(config.source, config.calibration)
    return [] if optics is None else [f"optics      {', '.join(meza2021.write_parameters(folder, optics))}"]


def _masks(masses: list[trimesh.Trimesh], world_from_pixel: NDArray, size: tuple[int, int]) -> Iterator[NDArray[np.uint8]]:
    """A mask a B-scan, 255 inside a mass."""
    for placed in world_from_pixel:
        yield np.where(mask_of(masses, placed, size), 255, 0).astype(np.uint8)
