"""Folders of other groups that `sonotwin export` writes. Each module is a layout, by the name that `layout=NAME` has.

A module has `TAKES`, names of the fields that it takes of `Settings`, beside `layout` and `out`; `ABOUT`, the words for its kind
of content, with which other fields are refused; and `write(folder, settings)`, which fills a folder that is there and returns
lines about it; InputError if there is nothing for it. Calibrations of cameras alone: `sonotwin.exported_cameras`.
"""

from pathlib import Path
from typing import Annotated

from pydantic import Field, PlainValidator, model_validator

from recon import registry
from recon.capture import calibration_files
from recon.errors import Implausible, InputError
from recon.model.probe import Speed
from recon.model.rig import Part, Positive
from recon.model.tracks import LagSeconds
from sonotwin.folder_lists import Folders

ScreenPixels = Annotated[int, Field(ge=320, le=8192)]


def _known(name: object) -> object:
    """The name of a layout of whole captures, or of a dialect of cameras that is written; else a refusal."""
    return registry.one_of(name, [*registry.names(__name__), *calibration_files.written()])


class Settings(Part):
    """What is exported, into which layout."""

    layout: Annotated[str, PlainValidator(_known)] = "meza2021"
    """meza2021: the rig authors' data sets; us_calibration: sets for their calibration of the probe; markerpose: their networks'
    training data, and their example's; screen: a scanner's recording, for import-sweep; dicom: results for a hospital's archive;
    a program's name, such as kalibr, ros, mrcal, slstudio: the calibration of cameras and projector alone"""
    capture: Folders = Field(default=[])
    """a capture folder, which meza2021 and screen need; of a sweep one with poses, as `sonotwin track` leaves it. us_calibration
    takes several, a set each: [first,second]"""
    out: Path
    """folder; gets SLdata/, USdata/ and the files of calibrations, as far as the capture has them"""
    calibration: Path | None = None
    """file: cameras and projector, in place of the capture's own; enough for a calibration alone"""
    surface: Path | None = None
    """folder of `sonotwin surface`, whose points make the mask; null takes all pixels. dicom takes its surface without the table,
    or a .ply as it is; null writes none"""
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
    """folder of `sonotwin segment`, whose masses make USmasks/, or segments, surfaces and report of dicom; null writes none"""
    volume: Path | None = None
    """folder of `sonotwin freehand`, which dicom needs, or a volume's file"""
    patient: Path | None = None
    """YAML file of dicom: name, id, birth_date, sex, accession_number, date ..., all of which may be left out;
    null names nobody"""
    data: Folders = Field(default=[])
    """data sets of `sonotwin dataset`, one or several, for markerpose"""
    networks: Folders = Field(default=[])
    """folders with detector.pt and segmenter.pt of the published shape, as of `sonotwin train network=published_detector`, or
    shipped, those that come with sonotwin; they go out by the names that the scripts load"""
    screen_px: tuple[ScreenPixels, ScreenPixels] = (1024, 768)
    """width, height of screens, px, 320 to 8192 each; B-scans keep their size on it. The default is that of many scanners"""

    @property
    def source(self) -> Path:
        """The only capture; InputError if none is given, or several."""
        if not self.capture:
            raise InputError("export: capture: needs a value; give capture=...")
        if len(self.capture) > 1:
            raise InputError(f"export: capture: expected one with layout={self.layout}, found {len(self.capture)}")
        return self.capture[0]

    @model_validator(mode="after")
    def _frames_are_written_if_they_are_limited(self) -> "Settings":
        if self.apart_s is not None and not self.frames:
            raise ValueError(f"apart_s: expected none with frames=false, which writes no frames, found {self.apart_s:g}")
        return self
