"""Verdicts: of each part of the rig its deviation, in standard deviations and in mm where it works, and what is to be done."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera
from recon.model.calibration import Calibration, Uncertainty
from recon.model.rig import Target
from recon.model.tracks import Track
from recon.rig_check import bottom_equations, fault_tests, optics_equations
from recon.rig_check.bottom_equations import CLOCK, PROBE, Known, Lines
from recon.rig_check.fault_tests import Equations, Finding
from recon.rig_check.optics_equations import CAMERAS, PROJECTOR, TARGET, Matches
from recon.tracking.pose_fit import Sighting, meet

Array = NDArray[np.float64]
State = Literal["good", "moved", "maybe", "open", "unseen"]

PARTS = (*CAMERAS, PROJECTOR, TARGET, PROBE, CLOCK)
TITLES = {
    "cam1": "camera 1",
    "cam2": "camera 2",
    PROJECTOR: "projector",
    TARGET: "target",
    PROBE: "probe on its bracket",
    CLOCK: "scanner's clock",
}
ANEW = {
    **dict.fromkeys((*CAMERAS, PROJECTOR), "calibrate-optics"),
    TARGET: "calibrate-target",
    PROBE: "calibrate-probe",
    CLOCK: "measure-lag",
}
GRID = (3, 3)  # pixels of a B-scan at which a probe's motion counts
STEP = 1e-3  # rad and mm, of slopes of displacements
BLIND = 0.7  # of the effect of a usual motion, that is left open: beyond, a check says nothing of the part


class Verdict(NamedTuple):
    """One part."""

    part: str
    state: State
    sigma: float = np.nan  # as of `fault_tests.Finding`
    mm: float = np.nan  # root mean square displacement of points measured in the working volume
    mm_sigma: float = np.nan  # standard deviation of that: smaller deviations aren't found
    motion: str = ""  # in words
    rivals: tuple[str, ...] = ()  # that explain all as well
    finding: Finding | None = None
    against: str = ""  # digest of what it was checked by: calibration, and kinds of recordings


class Optics(NamedTuple):
    """What was taken of cameras and projector; either may be missing."""

    film: Sequence[tuple[Sighting, Sighting]] | None
    matches: Matches | None


def of_optics(
    seen: Optics,
    calibration: Calibration,
    known: Uncertainty,
    target: Target,
    alarm_sigma: float,
    daily: Uncertainty | None = None,
) -> list[Verdict]:
    """Verdicts on cameras, projector and target.

    known : the calibration's uncertainty, with what is usual since it was made, as of `recon.model.calibration.in_use`.
    daily : usual drift, as of `recon.rig_check.drift.usual_drift`, that is other each day.
    """
    return of_equations(equations_of(seen, calibration, known, target, daily), seen, calibration, target, alarm_sigma)


def equations_of(
    seen: Optics, calibration: Calibration, known: Uncertainty, target: Target, daily: Uncertainty | None = None
) -> Equations:
    """Equations of cameras, projector and target by all that was taken; points that disagree with most others are left out."""
    cameras, names = calibration.cameras, optics_equations.parameters(known, list(calibration.cameras))
    film = None if seen.film is None else optics_equations.of_film(seen.film, target, names)
    fringes = None
    if seen.matches is not None:
        each = 2 * len(seen.matches.axes) - 1
        fringes = optics_equations.of_fringes(seen.matches, cameras, target, names)
        fringes = optics_equations.agreeing(fringes, target, known, names, each)
    return optics_equations.assemble(film, fringes, target, known, names, daily)


def of_equations(
    equations: Equations, seen: Optics, calibration: Calibration, target: Target, alarm_sigma: float
) -> list[Verdict]:
    """Verdicts on cameras, projector and target by their equations."""
    cameras, findings = calibration.cameras, fault_tests.find(equations, alarm_sigma)
    axes = (0,) if seen.matches is None else seen.matches.axes
    points = np.concatenate([_film_points(seen), _lit_points(seen, cameras)])
    effects = {
        device: _slopes(lambda motion, device=device: optics_equations.displacements(device, motion, calibration, points, axes))
        for device in findings
        if device != TARGET
    }
    effects[TARGET] = np.eye(len(target.LENGTHS))[None]
    return _verdicts(findings, effects, (*CAMERAS, PROJECTOR, TARGET))


def of_bottom(
    lines: Lines, track: Track, known: Known, size: tuple[int, int], speed_mm_s: float, alarm_sigma: float
) -> tuple[list[Verdict], float]:
    """Verdicts on probe and clock, and the lag that was found, s.

    size : of the B-scans, px.
    speed_mm_s : of a hand, by which an error of the clock becomes one of place.

    Raises
    ------
    InputError
        As of `bottom_equations.fit`.
    """
    bottom = bottom_equations.fit(lines, track, known)
    findings = fault_tests.find(bottom_equations.equations(lines, track, known, bottom), alarm_sigma)
    spans = (np.linspace(0, length - 1, count) for length, count in zip(size, GRID, strict=True))
    pixels = np.stack(np.meshgrid(*spans), axis=-1).reshape(-1, 2)
    bend = _slopes(lambda motion: bottom_equations.displacements(motion, known.probe, pixels))
    effects = {PROBE: bend, CLOCK: np.array([[[speed_mm_s]]])}
    return _verdicts(findings, effects, (PROBE, CLOCK)), bottom.lag_s


def _verdicts(findings: Mapping[str, Finding], effects: Mapping[str, Array], parts: Sequence[str]) -> list[Verdict]:
    """In the order of the parts; those that nothing shows are unseen.

    effects : of a part's motion : (k,), displacements of n points, as (n, 3 or so, k) mm.
    """
    doubtful = {rival for finding in findings.values() if finding.named for rival in finding.rivals}
    verdicts = []
    for part in parts:
        if part not in findings:
            verdicts.append(Verdict(part, "unseen"))
            continue
        finding, effect = findings[part], effects[part].reshape(-1, effects[part].shape[-1])
        count = len(effects[part])
        mm = float(np.sqrt(np.sum((effect @ finding.motion) ** 2) / count))
        sigma = float(np.sqrt(np.einsum("ni,ij,nj->", effect, finding.covariance, effect) / count))
        usual = float(np.sqrt(np.sum((effect * finding.usual) ** 2) / count))
        state: State = "moved" if finding.named else "maybe" if part in doubtful else "open" if sigma > BLIND * usual else "good"
        words = described(part, finding.motion)
        verdicts.append(Verdict(part, state, finding.sigma, mm, sigma, words, finding.rivals, finding))
    return verdicts


def doubted(verdicts: Sequence[Verdict], by: Sequence[Verdict]) -> list[Verdict]:
    """Verdicts on what was tracked by cameras that may have moved: what seems to have moved beside them stays open."""
    if not any(one.state in ("moved", "maybe") and one.part != PROJECTOR for one in by):
        return list(verdicts)
    unsure = [one._replace(finding=None) for one in verdicts]
    return [one._replace(state="open") if one.state in ("moved", "maybe") else one for one in unsure]


def described(part: str, motion: Array) -> str:
    """A motion in words."""
    if part == CLOCK:
        return f"{1e3 * motion[0]:+.1f} ms"
    if part == TARGET:
        c1, *others = motion.tolist()
        sides = [
            f"c{k} {x:+.2f} aside and {y:+.2f} mm along"
            for k, (x, y) in enumerate(zip(others[::2], others[1::2], strict=True), 2)
        ]
        return ", ".join([f"c1 {c1:+.2f}", *sides])
    turn, shift = np.degrees(np.linalg.norm(motion[:3])), np.linalg.norm(motion[3:])
    return f"turned by {turn:.3f} deg, shifted by {shift:.2f} mm"


def _slopes(displacements: Callable[[Array], Array]) -> Array:
    """Derivatives : (n, 3, 6) of displacements : (n, 3) mm by a motion, about none; points that are lost are left out."""
    slopes = np.stack([displacements(step) / STEP for step in STEP * np.eye(6)], axis=-1)
    return slopes[np.isfinite(slopes).all(axis=(1, 2))]


def _film_points(seen: Optics) -> Array:
    """Places : (n, 3) mm of the target's circles."""
    pairs = seen.film or ()
    points = [meet([view.camera for view in pair], [view.centres for view in pair])[0] for pair in pairs]
    return np.concatenate(points) if points else np.zeros((0, 3))


def _lit_points(seen: Optics, cameras: Mapping[str, Camera]) -> Array:
    """Places : (n, 3) mm of the surface under fringes."""
    if seen.matches is None:
        return np.zeros((0, 3))
    return optics_equations.points_by_light(seen.matches.pixels, seen.matches.first, seen.matches.axes, cameras)
