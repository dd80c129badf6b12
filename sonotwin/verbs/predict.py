"""Predict what errors a rig will find, before anything is recorded, and what would lower that of a plane.

Reads a rig, such as rig=ours/rig.yaml of `sonotwin identify`, with patterns, a plate and settings of light and exposure; renders
nothing. Says the RMS distance of points from their plane, with the interval that the rig's measured numbers leave; by how many
per cent it changes for one per cent of each number of the rig, where it does: -1 is an error that halves when the number doubles.
Numbers that weren't measured count as exact, and are named: flux, quantum efficiency and pixels' sizes, with them nominal focal
lengths, of which `identify` measures none, and often others. The projector's light counts as a power of its values.
`changes` are other values of any fields, each with its price: they are tried one by one, the most error saved for the money
first. Takes some seconds.

The noise of camera 1, the projector's raster and the errors of a calibration whose covariance the rig has are in it; light that
spreads in skin isn't. Of the errors of frames in `conditions` flicker costs light, as the exposure is set for the brightest
frame; all of them count to the phases of three steps, while those of four or more are corrected. Fringes along columns, rows or
both count as in the reconstruction, and Gray code alone by its cells. With `sessions` whole ones are drawn, from the board to a
mass, with the errors of `conditions`: what detectors would find is drawn, and the real software does the rest. They say the
errors of points, pixels of B-scans and masses' centres. With `rehearsals` the rig's twin calibrates its probe by crossed wires
and sweeps a phantom's masses so many times, by rendered frames and B-scans, a minute each. That says CR1 and the errors of
masses, and sessions are drawn with the noise that detectors have there, else with that of the paper's rig, scaled to this one.

    sonotwin predict
    sonotwin predict patterns=gray_surface plate.centre_mm=[4,-2,700] conditions.frames.flicker=0.02
    sonotwin predict conditions=lifelike sessions=24 rehearsals=2
    sonotwin predict "changes={rig.projector.radiant_flux_w: {to: 1.2, price: 800}, patterns.parts.1.steps: {to: 16, price: 0}}"
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from recon.errors import InputError, one_line
from recon.model.part import Finite, NotNegative, Part, Positive
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from scenes.board_poses import Config as BoardPoses
from scenes.kinds import plane
from sonotwin.config import defaults
from sonotwin.console_watch import LineConsole
from sonotwin.experiment_settings import settings_of
from twin.conditions import IDEAL, Conditions
from twin.evaluation.surface_errors import rms
from twin.experiments import predicted_plane, predicted_session, rehearsal
from twin.experiments.experiment_runs import Settings
from twin.experiments.predicted_plane import Measurement
from twin.experiments.rehearsal import Rehearsed
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting
from twin.ultrasound.transducer import Transducer

TOLD = 0.02  # relative change of the error by that of a number: less isn't told
NUMBERS = (
    *(f"cam1.lens.{name}" for name in ("f_number", "focus_mm", "blur_px", "vignetting")),
    *(f"cam1.sensor.{name}" for name in ("saturation_e", "dark_noise_e", "black_level_dn", "quantum_efficiency")),
    *(f"projector.lens.{name}" for name in ("f_number", "focus_mm", "blur_px", "vignetting")),
    *(f"projector.{name}" for name in ("radiant_flux_w", "gamma", "contrast")),
)


class Change(Part):
    """Another value of a field, and what it costs."""

    to: Finite
    price: NotNegative = 0.0


def _two_or_none(count: int) -> int:
    if count == 1:
        raise ValueError("expected 0 or at least 2, which show how they differ, found 1")
    return count


class Config(Part):
    """Fields of `conf/predict.yaml`."""

    rig: Rig
    patterns: Patterns
    tracing: Tracing
    plate: plane.Config = plane.Config()
    shooting: Shooting = Shooting()
    conditions: Conditions = IDEAL
    poses: BoardPoses = BoardPoses()
    ultrasound: Transducer = Transducer()
    sessions: Annotated[int, Field(ge=0, le=10_000), AfterValidator(_two_or_none)] = 0
    rehearsals: Annotated[int, Field(ge=0, le=100), AfterValidator(_two_or_none)] = 0
    white_dn: Positive = 65.0
    changes: dict[str, Change] = Field(default_factory=dict)


def run(config: Config) -> None:
    """Predict, and say what would lower the error; raises InputError for a change of what isn't there, or that can't be."""
    console = LineConsole()
    changed = {name: _changed(config, name, change) for name, change in config.changes.items()}
    try:
        lines = list(describe(config, changed))
    except ValueError as error:
        raise error if isinstance(error, InputError) else InputError(f"predict: {error}") from error
    for line in lines:
        console.print(line, markup=False)


def describe(config: Config, changed: Mapping[str, Config]) -> Iterator[str]:
    """Lines: the error, its interval and causes, the numbers that it depends on, and the changes, the best for its price."""
    rig, found = config.rig, predicted_plane.predict(config.rig, measurement_of(config))
    sigma = predicted_plane.uncertainty(rig, measurement_of(config))
    known = f"± {1.96 * sigma:.4f} mm (95 %, by {len(rig.measured)} measured numbers, if all others are as the rig has them)"
    unknown = "of unknown uncertainty: none of the rig's numbers was measured, see `sonotwin identify`"
    yield f"predicted   plane {found.rms_mm:.4f} mm RMS, {known if rig.measured else unknown}"
    optics = "not counted (no covariance in the rig)" if rig.optics_covariance is None else f"{found.optics_mm:.4f} mm"
    parts = (
        f"noise {found.noise_mm:.4f} mm, frames {found.frames_mm:.4f} mm, raster {found.mirrors_mm:.4f} mm, calibration {optics}"
    )
    yield f"by          {parts}; modulation {found.modulation_dn:.0f} DN, exposure {1e3 * found.exposure_s:.2f} ms"
    if config.rehearsals or config.sessions:
        yield from _sessions(config, _session(config))
    for name, slope in predicted_plane.elasticities(rig, measurement_of(config), NUMBERS).items():
        if abs(slope) >= TOLD:
            sigma = f"± {rig.measured[name].sigma:.2g}" if name in rig.measured else "taken as exact"
            yield f"depends     {name} {rig.number(name):g} ({sigma}): {slope:+.2f} % a per cent"
    saved = {
        name: (found.rms_mm - predicted_plane.predict(other.rig, measurement_of(other)).rms_mm, config.changes[name])
        for name, other in changed.items()
    }
    for name, (less, change) in sorted(saved.items(), key=lambda pair: -_worth(*pair[1])):
        yield f"change      {name} to {change.to:g}: {100 * less / found.rms_mm:+.1f} % less error for {change.price:g}"


def _sessions(config: Config, session: Settings) -> Iterator[str]:
    """Lines of rehearsed and of drawn sessions."""
    if config.rehearsals:
        rehearsed = rehearsal.rehearse(session, config.rehearsals, config.rehearsals, seed=0)
        session = session.model_copy(update={"noise": rehearsal.noise_of(session, rehearsed.wires)})
        yield from _rehearsed(rehearsed)
    if config.sessions:
        for figure, one in predicted_session.predict(session, range(config.sessions)).items():
            of = f"of {config.sessions} drawn sessions, {one.worst:.2g} mm in the worst"
            yield f"predicted   {predicted_session.FIGURES[figure]} {one.rms:.3f} ± {1.96 * one.sigma:.2g} mm RMS (95 %) {of}"


def _rehearsed(found: Rehearsed) -> Iterator[str]:
    """Lines: CR1 and its scatter, the noise of detectors, the errors of masses."""
    seen, cr1 = found.wires.seen, found.repeatability
    of = f"of {rehearsal.IMAGES} B-scans each; {100 * seen.shown:.0f} % of poses show the crossing"
    yield f"predicted   CR1 {cr1.mm:.3f} ± {1.96 * cr1.known * cr1.mm:.3f} mm (95 %), mean of five points, {of}"
    noise = f"circles {seen.circle_px:.3f} px, crossings {seen.crossing_px:.2f} px"
    yield f"by          {noise}; CR1 of {rehearsal.FEW} calibrations scatters by {100 * cr1.of_few:.0f} %"
    there, (centre_mm, volume) = np.isfinite(found.masses.volume), found.masses
    errors = "none found"
    if there.any():
        errors = f"centre {rms(np.linalg.norm(centre_mm[there], axis=1)):.3f} mm, volume {100 * rms(volume[there]):.0f} % RMS"
    yield f"predicted   masses of 8 mm by segmentation alone: {errors}, {there.sum()} of {len(volume)} found"


def measurement_of(config: Config) -> Measurement:
    """What is to be measured."""
    return Measurement(config.patterns, config.plate, config.shooting, config.tracing, config.conditions.frames)


def _session(config: Config) -> Settings:
    """The same rig in a whole session; all else as in `conf/study.yaml`."""
    names = ("rig", "conditions", "poses", "ultrasound", "patterns", "shooting", "tracing")
    made = Settings.model_validate(settings_of(defaults("study") | {name: getattr(config, name) for name in names}))
    return made.model_copy(update={"film": made.film.model_copy(update={"white_dn": config.white_dn})})


def _worth(saved_mm: float, change: Change) -> float:
    """Error saved for the money; of what costs nothing, all that it saves counts."""
    return saved_mm / change.price if change.price else saved_mm * 1e9


def _changed(config: Config, name: str, change: Change) -> Config:
    """The fields with another value."""
    content: Any = config.model_dump(mode="json", exclude={"changes"})
    inner = content
    *parents, last = name.split(".")
    try:
        for key in parents:
            inner = inner[int(key)] if isinstance(inner, list) else inner[key]
        key = int(last) if isinstance(inner, list) else last
        inner[key] = round(change.to) if isinstance(inner[key], int) and not isinstance(inner[key], bool) else change.to
        return Config.model_validate(content)
    except (KeyError, IndexError, ValueError, TypeError) as error:
        if isinstance(error, ValidationError):
            raise InputError(f"changes: {name}: {one_line(error)}") from error
        raise InputError(f"changes: expected the name of a field, such as rig.projector.gamma, found {name}") from None
