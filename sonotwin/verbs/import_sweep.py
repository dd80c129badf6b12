"""Read a scanner's clip of B-scans and a tracker's table of poses into a capture, which all other verbs take.

A clip is a DICOM file of many frames, a video of the scanner's screen, or a folder of images. Its B-scan's part is cut out: the
region that a DICOM file names, else what changes from frame to frame; colours become grey. Times are the clip's own, or even by
`rate_hz`. The table is CSV with columns of any name, or by number without a header: a time, or null where it has a row a frame,
and a translation with a quaternion or a matrix; a row without values is one in which the probe wasn't seen. Writes the capture
folder `out`; one that is there already is replaced. Takes seconds.

    sonotwin import-sweep clip=scan.dcm poses=poses.csv columns='{time: t, matrix: [a,b,c,d,e,f,g,h,i,j,k,l]}' out=sweep/capture
    sonotwin import-sweep clip=screen.mp4 poses=p.csv columns='{time: t, translation: [x,y,z], quaternion: [a,b,c,d]}' out=capture
    sonotwin import-sweep clip=stills poses=p.txt columns='{time: null, matrix: [1,2,3,4,5,6,7,8,9,10,11,12]}' out=capture
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.capture.manifest import SCANNER, Device, Purpose
from recon.capture.writer import new_capture
from recon.clips import clip_reader, image_region, pose_tables
from recon.clips.clip import Box, Clip
from recon.clips.pose_tables import MOST_SECONDS, Columns
from recon.errors import Implausible, InputError
from recon.files import atomic
from recon.freehand import volume_compounding
from recon.model import pose_checks, tracks
from recon.model.rig import Part
from recon.model.tracks import Track
from sonotwin.console_watch import LineConsole

Least = Annotated[int, Field(ge=0)]
Size = Annotated[int, Field(ge=8)]


class Config(Part):
    """Fields of `sonotwin import-sweep`."""

    clip: Path
    """B-scans: a DICOM file of many frames, a video (mp4, avi, mov, mkv, ...), or a folder of images in natural order"""
    poses: Path
    """the tracker's poses: a CSV table with a header, separated by commas, semicolons, tabs or blanks"""
    columns: Columns
    """names of its columns, or their numbers from 1 where it has no header, and their units"""
    out: Path
    """the capture folder to write"""
    rate_hz: Annotated[float, Field(ge=0.01, le=1e5)] | None = None
    """frames/s; null: as the clip says"""
    starts_s: Annotated[float, Field(gt=-MOST_SECONDS, lt=MOST_SECONDS)] | None = None
    """s, time of the first frame by the table's clock; null: the clip begins with the table. measure-lag finds the rest"""
    crop: Literal["auto", "whole"] | tuple[Least, Least, Size, Size] = "auto"
    """auto: the B-scan's part, as the DICOM file says, else what changes from frame to frame; whole; or [u,v,width,height] in
    px"""
    purpose: Purpose = "volume"
    """of the sweep: probe, of crossed wires; latency, of a flat bottom; volume"""
    implausible: Implausible = "refuse"
    """poses that no hand makes: refuse leaves them out, and refuses if they are many; take uses all of them"""


def run(config: Config) -> None:
    """Read clip and table, and write the capture.

    Raises
    ------
    InputError
        If one is missing or damaged, they have no time in common, or `out` can't be written to.
    """
    console = LineConsole()
    atomic.check_folder(config.out, "import-sweep", inputs=[config.clip, config.poses])
    track = None if config.columns.time is None else pose_tables.read(config.poses, config.columns)
    with console.status("reading the clip"):
        clip = clip_reader.read(config.clip)
        times = stamps(config, clip, track)
        box = b_scan(config, clip)
        track = believed(config, clip, times, track or pose_tables.read(config.poses, config.columns, times))
    width, height = box[2:]
    with console.status("writing"), new_capture(config.out, config.clip.stem, by="import-sweep") as capture:
        devices = {SCANNER: Device(size=(width, height))}
        capture.add_sweep({SCANNER: times}, _cut(clip, box), devices, track, purpose=config.purpose)
    for line in describe(config, clip, times, box, track):
        console.print(line, markup=False)
    console.print(f"wrote       {config.out}", markup=False)


def believed(config: Config, clip: Clip, times: NDArray[np.int64], track: Track) -> Track:
    """The poses without those that no hand makes; InputError if these are many, see `recon.model.pose_checks`."""

    def images() -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        return 1e-9 * (times - track.times[0]), pose_checks.small_images(clip.stream())

    seconds = 1e-9 * (track.times - track.times[0])
    place, unit = str(config.poses), "columns.length_unit"
    poses, _ = pose_checks.without_implausible(place, seconds, track.poses, config.implausible, images, unit=unit)
    pose_checks.check_motion(place, seconds, poses, config.implausible, unit)
    return replace(track, poses=poses)


def stamps(config: Config, clip: Clip, track: Track | None) -> NDArray[np.int64]:
    """Times : (n,) ns of the clip's frames, by the table's clock; of a table without times, by the clip's or a second apart.

    Raises
    ------
    InputError
        If the clip has no times and none are given, or no frame is taken while there are poses.
    """
    seconds = clip.seconds
    if config.rate_hz is not None:
        seconds = np.arange(clip.count) / config.rate_hz
    if seconds is None and track is None:
        seconds = np.arange(clip.count, dtype=float)
    if seconds is None:
        raise InputError(f"{config.clip}: expected times of the frames, found none; give rate_hz=...")
    begin = 0 if track is None else int(track.times[0])
    start = begin if config.starts_s is None else round(1e9 * config.starts_s)
    times = start + np.rint(1e9 * seconds).astype(np.int64)
    if track is None:
        return times
    if times[-1] < track.times[0] or times[0] > track.times[-1]:
        found, expected = (f"{1e-9 * some[0]:.3f} to {1e-9 * some[-1]:.3f} s" for some in (times, track.times))
        raise InputError(f"starts_s: expected frames while there are poses, {expected}, found {found}")
    return times


def b_scan(config: Config, clip: Clip) -> Box:
    """The B-scan's part of the frames; InputError if one that is given or named isn't within them, or none is found."""
    width, height = clip.size
    if config.crop == "whole":
        return 0, 0, width, height
    if config.crop == "auto":
        if clip.image is None:
            return image_region.find(clip.stream(), str(config.clip), "crop=[u,v,width,height]")
        u, v, wide, tall = clip.image
        if u + wide > width or v + tall > height:
            raise InputError(
                f"{config.clip}: SequenceOfUltrasoundRegions: expected a region within the image of {width}x{height} px, "
                f"found {wide}x{tall} px from ({u}, {v}); shrunk or cropped since it was taken? give crop=[u,v,width,height]"
            )
        return clip.image
    u, v, wide, tall = config.crop
    if u + wide > width or v + tall > height:
        raise InputError(f"crop: expected a part of {width}x{height} px, found {u + wide}x{v + tall} at its lower right")
    return config.crop


def describe(config: Config, clip: Clip, times: NDArray[np.int64], box: Box, track: Track) -> Iterator[str]:
    """Lines for the console: frames, the B-scan's part and scale, and poses."""
    rate = (len(times) - 1) / max(1e-9 * float(times[-1] - times[0]), 1e-9)
    yield f"clip        {len(times)} frames, {clip.size[0]}x{clip.size[1]} px, {rate:.4g} a second"
    u, v, width, height = box
    how = "as given" if config.crop != "auto" else "as the file says" if clip.image else "which changes from frame to frame"
    yield f"B-scan      {width}x{height} px from ({u}, {v}), {how}"
    fields = f"rig.probe.image_size=[{width},{height}]"
    if clip.mm_per_px is not None:
        fields += " rig.probe.scale_mm_per_px=[{:.6g},{:.6g}]".format(*clip.mm_per_px)
    yield f"give        {fields} to calibrate-probe"
    placed = np.isfinite(tracks.at(track, times)).all(axis=(1, 2))
    span = f"{1e-9 * (track.times[-1] - track.times[0]):.4g} s"
    yield f"poses       {track.found.sum()} of {len(track.times)} rows, {span}; {placed.sum()} of {len(times)} frames have one"
    if line := pose_checks.coverage(placed):
        yield f"warning     {line}; does the clip begin with the table? give starts_s"


def _cut(clip: Clip, box: Box) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    part = volume_compounding.Clip(*box)
    return ((SCANNER, part.cut(frame)) for frame in clip.stream())
