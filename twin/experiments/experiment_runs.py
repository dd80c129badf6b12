"""Experiments that studies are made of: from settings and a seed to figures, on any machine the same.

A trial is one run of an experiment. Each experiment reads some of the settings, so a factor among the others is refused, and a
trial that is kept isn't done anew when these change.
"""

import hashlib
import importlib.metadata
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from socket import gethostname
from typing import Annotated, Any, Literal

import cv2
from pydantic import Field, field_validator, model_validator

from recon.errors import InputError
from recon.files.code_digest import code_digest, is_unchanged
from recon.files.metrics import Metrics
from recon.model.patterns import Patterns
from recon.model.rig import Part, Positive, Rig
from scenes.anatomy import Density
from scenes.board_poses import Config as BoardPoses
from scenes.kinds.board import Config as Board
from twin.conditions import IDEAL, Conditions
from twin.experiments.drawn_session import ROLL_DEG, Noise
from twin.experiments.layout import Layout
from twin.experiments.mass_conditions import MassCondition
from twin.llvm import prepare
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting
from twin.shooting import power_of_two
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound.probe_path import WirePath
from twin.ultrasound.transducer import Transducer, check_scanner

MODULES = {  # where an experiment's EXPERIMENT is
    "surface": "twin.experiments.surface_trial",
    "calibration": "twin.experiments.calibration_trial",
    "tracking": "twin.experiments.tracking_trial",
    "laboratory": "twin.experiments.laboratory_trial",
    "chain": "twin.experiments.chain_trial",
    "tank": "twin.experiments.tank_trial",
    "breast": "twin.experiments.breast_trial",
    "patient": "twin.experiments.patient_trial",
    "masses": "twin.experiments.mass_trial",
    "seen": "twin.experiments.seen_trial",
    "identify": "twin.experiments.identify_trial",
    "training": "twin.experiments.training_trial",
    "acceptance": "twin.experiments.acceptance_audit",
    "session": "twin.experiments.session_trial",
    "biopsy": "twin.experiments.biopsy_trial",
}
DIGITS = 6  # significant, of figures
PACKAGES = ("recon", "scenes", "twin")  # by whose code figures are made
Fault = Literal["none", "noise", "scale", "bend"]
LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "mitsuba", "drjit", "onnxruntime")


class Plane(Part):
    """Where a plane stands that is measured."""

    depth_mm: Positive | None = None  # z of its middle; the paper's five planes in turn, 622 to 698 mm, if not given


class Film(Part):
    """Frames of the tracked target."""

    frames: Annotated[int, Field(ge=1, le=10_000)] = 12  # pairs, each in a pose of its own
    white_dn: Positive = 65.0  # of 255, of the target's paper
    blur_px: Annotated[float, Field(ge=0, le=100)] = 0.0  # by which the target's middle moves while a frame is exposed
    rays: Annotated[int, Field(ge=2, le=1024)] = 64  # a pixel, a power of two; few leave noise of rendering

    _power_of_two = field_validator("rays")(power_of_two)


class SeenTissue(Part):
    """Breasts with masses that may be found or not."""

    tissue: Literal["silicone", "patients"] = "silicone"


class AcceptedRig(Part):
    """A rig whose acceptance is tested."""

    fault: Fault = "none"  # noise, a scale or a bend make errors of twice the limit


class Biopsy(Part):
    """A patient of a virtual trial."""

    rig: Literal["identified", "data_sheet", "worn"] = "data_sheet"  # how well it is known
    training: Literal["novice", "trained"] = "trained"  # of the hand that leads the needle
    tissue: Density = "scattered"
    measured: Literal["drawn", "rendered"] = (
        "drawn"  # how the planned place is found: by drawn detections, or from rendered images
    )


class Settings(Part):
    """All that experiments are made from; as in `conf/study.yaml`."""

    rig: Rig
    layout: Layout = Layout()
    patterns: Patterns  # over surfaces
    board_patterns: Patterns
    board: Board = Board()
    poses: BoardPoses = BoardPoses()
    conditions: Conditions = IDEAL
    tracing: Tracing = Tracing()
    shooting: Shooting = Shooting()
    plane: Plane = Plane()
    film: Film = Film()
    noise: Noise = Noise()
    wire_path: WirePath = WirePath(count=45, roll_deg=ROLL_DEG)
    ultrasound: Transducer = Transducer()
    masses: MassCondition = MassCondition()
    seen: SeenTissue = SeenTissue()
    acceptance: AcceptedRig = AcceptedRig()
    biopsy: Biopsy = Biopsy()
    ranges: DataRanges

    @model_validator(mode="after")
    def _fit(self) -> "Settings":
        raster = self.rig.projector.optics.size
        for name in ("patterns", "board_patterns"):
            if (shown := getattr(self, name).projector_size) != raster:
                raise ValueError(f"{name}.projector_size: expected the rig's {list(raster)}, found {list(shown)}")
        if not self.patterns.has_fringes("columns"):
            raise ValueError("patterns: expected fringes along columns, which closed forms are of, found none")
        check_scanner(self.rig, self.ultrasound)
        return self


@dataclass(frozen=True)
class Experiment:
    """One kind of trial."""

    reads: tuple[str, ...]  # fields of the settings, or parts of fields, by dotted names
    measure: Callable[[Settings, int], Metrics]  # figures by name, the unit in the name, of settings and a seed
    limits: Mapping[str, str]  # figures that are plotted, and the figure that each is held against, or ""
    limit: str = "closed form"  # what these are
    counts: tuple[str, ...] = ()  # figures that a study adds up over its trials
    predict: Callable[[Settings, int], Metrics] | None = None  # some of the figures by formulas, in milliseconds
    packages: tuple[str, ...] = ()  # by whose code its figures are made, beside PACKAGES
    libraries: tuple[str, ...] = ()  # distributions of others, beside LIBRARIES


def experiment(name: str) -> Experiment:
    """An experiment by its name."""
    return import_module(MODULES[name]).EXPERIMENT


def check_reads(name: str, fields: Iterable[str]) -> None:
    """Refuse fields that an experiment doesn't read; raises InputError with the name of one."""
    reads = experiment(name).reads
    for field in fields:
        if not any(f"{field}.".startswith(f"{read}.") or f"{read}.".startswith(f"{field}.") for read in reads):
            raise InputError(
                f"over: {field}: expected a field that of={name} reads, of {', '.join(reads)}; it would change nothing"
            )


def read_by(name: str, settings: Settings) -> dict[str, Any]:
    """The settings that an experiment reads, as JSON has them."""
    return settings.model_dump(mode="json", include={read.partition(".")[0] for read in experiment(name).reads})


@cache
def version(packages: tuple[str, ...] = (), libraries: tuple[str, ...] = ()) -> str:
    """Digest of all that figures depend on beside settings and seed: code, libraries and the ray tracer's.

    packages, libraries : beside PACKAGES and LIBRARIES

    Raises
    ------
    ModuleNotFoundError
        If a library isn't installed.
    """
    versions = {name: importlib.metadata.version(name) for name in LIBRARIES + libraries}
    content = json.dumps([code_digest(*PACKAGES, *packages), versions, prepare()], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:12]


def digest(name: str, settings: Settings, seed: int) -> str:
    """Name of a trial: by all that its figures depend on."""
    of = experiment(name)
    content = json.dumps([version(of.packages, of.libraries), name, read_by(name, settings), seed], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:20]


@contextmanager
def same_code(asked: str, here: str, packages: tuple[str, ...] = ()) -> Iterator[None]:
    """Measure figures that are kept under a name which is made of the code: it must be so here, before and afterwards.

    asked, here : the name as who asks made it, and as it is on this machine
    packages : by whose code figures are made, beside PACKAGES

    Raises
    ------
    InputError
        If this machine's code or libraries aren't those of who asks, or code was edited meanwhile, some of which may have been
        imported after that.
    """
    expected = "expected workers with the code and the libraries of this machine"
    if asked != here:
        raise InputError(
            f"engine: {expected}, found others at {gethostname()}; was code edited since the run began? start it again"
        )
    yield
    if not is_unchanged(*PACKAGES, *packages):
        advice = "start it again, in a copy of the code if you go on editing; what was kept before stays"
        raise InputError(f"engine: {expected}, found it edited meanwhile at {gethostname()}; {advice}")


def run_trial(key: str, name: str, settings: Settings, seed: int) -> tuple[str, Metrics | str]:
    """Run a trial, and give its figures, or in one line why there are none: settings that nothing can be measured with.

    Figures have DIGITS significant digits: those beyond the eleventh of what they are made of may depend on where linear algebra
    finds its buffers.

    Raises
    ------
    InputError
        As `same_code` does.
    """
    of = experiment(name)
    with same_code(key, digest(name, settings, seed), of.packages):
        return key, _figures(of.measure, settings, seed)


def predict_trial(name: str, settings: Settings, seed: int) -> Metrics | str:
    """What an experiment's formulas predict of a trial's figures, or in one line why they can't; InputError if it has none."""
    predict = experiment(name).predict
    if predict is None:
        raise InputError(f"search: by: prediction needs an experiment with formulas, such as of=surface, found of={name}")
    return _figures(predict, settings, seed)


def _figures(measure: Callable[[Settings, int], Metrics], settings: Settings, seed: int) -> Metrics | str:
    try:
        return {figure: float(f"{value:.{DIGITS}g}") for figure, value in measure(settings, seed).items()}
    except (ValueError, cv2.error) as error:  # InputError too
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        return kind + " ".join(str(error).split())
