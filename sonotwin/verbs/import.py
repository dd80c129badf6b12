"""Read another group's folder into a capture, which all other verbs take.

All layouts are of programs of the rig's authors, each read as far as it is there. `layout=meza2021` is that of their data sets:
SLdata/images, USdata/L, R and US, target_pose.npy, cross_point.npy, and the files of their calibrations; `us_calibration`, of the
probe's calibration: folders data1, data2, ... with L, R and UScrop, each a sweep, and cam1_cam2.npz; `stereo_basler`, of one
recording of their acquisition: L, R and UScrop or US; `markerpose`, of their tracker's example: images/L, R and StereoParams.xml.
Images of any common kind become grey PNG. Their frames have no time stamps: frame k of all devices is taken at one moment,
`camera_hz` a second. Rotations that are off by up to 2 % are taken as the nearest ones, and a negative scale as the same map,
each with a warning. Writes the capture folder `out`; where poses and crossings of wires are there, pairs.csv in it
(pairs_data1.csv, ... of sets), for `calibrate-probe`. A capture that is there already is replaced. Takes seconds.

    sonotwin import folder=dataset out=session/capture
    sonotwin import folder=dataset speed_m_s=1488 purpose=probe out=wires/capture
    sonotwin import layout=us_calibration folder=dataset out=wires/capture
    sonotwin import layout=stereo_basler folder=acquisition out=stills/capture
"""

from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import Field, PlainValidator

from recon import registry
from recon.capture.layouts import Known, meza2021
from recon.capture.manifest import Purpose
from recon.capture.writer import new_capture
from recon.errors import InputError
from recon.files import atomic
from recon.model.probe import Speed
from recon.model.rig import Part, Positive
from sonotwin.console_watch import LineConsole

LAYOUTS = "recon.capture.layouts"  # a module each
Pixels = Annotated[int, Field(ge=8, le=20000)]


class Config(Part):
    """Fields of `sonotwin import`."""

    layout: Annotated[str, PlainValidator(partial(registry.known, LAYOUTS))] = "meza2021"
    """meza2021: the rig authors' data sets; us_calibration: sets for their calibration of the probe; stereo_basler: a recording
    of their acquisition; markerpose: the example of their tracker"""
    folder: Path
    """folder with SLdata/, USdata/ and files of calibrations; with data1/, data2/, ...; or with L/, R/ and UScrop/"""
    out: Path
    """the capture folder to write"""
    camera_hz: Positive | None = None
    """frames/s; their frames have no time stamps, and all devices' count as taken at once. null: 30, and 1 of stills, so of
    the other layouts"""
    purpose: Purpose | None = None
    """of the sweep: probe, of crossed wires; latency, of a flat bottom; volume. null: volume of meza2021, probe of
    us_calibration"""
    projector_size: tuple[Pixels, Pixels] = meza2021.PROJECTOR_SIZE
    """px; their files don't store it"""
    speed_m_s: Speed | None = None
    """m/s, of sound for which US_params.npz is right; their file doesn't say. Of wires in water of 22 deg C: 1488. null: as a
    file of ours says, or its export, else 1540, with a warning"""


def run(config: Config) -> None:
    """Read what is there, and write the capture.

    Raises
    ------
    InputError
        If nothing of the layout is there, a field is given that it has no place for, a file is damaged, parts don't fit together,
        or `out` can't be written to.
    """
    console = LineConsole()
    atomic.check_folder(config.out, "import", inputs=[config.folder])
    kind = registry.kind(LAYOUTS, config.layout)
    known = Known(config.camera_hz, config.purpose, config.projector_size, config.speed_m_s)
    for name, value in vars(known).items():
        if name not in kind.TAKES and value != Config.model_fields[name].default:
            raise InputError(
                f"import: {name}: expected none with layout={config.layout}, which has no place for it, found {value}"
            )
    fill = kind.read_capture(config.folder, known)
    with console.status("writing"), new_capture(config.out, config.folder.resolve().name, by="import") as capture:
        lines = fill(capture)
    for line in lines:
        console.print(line, markup=False)
    console.print(f"wrote       {config.out}", markup=False)
