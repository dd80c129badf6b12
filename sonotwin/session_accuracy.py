"""Accuracy of whole sessions: rendered, reconstructed from their images alone, and compared with the truth.

Each seed draws hand, light, speckle, noise and conditions anew. The figures of a seed are kept beside the tables, with a digest
of the code and the settings that made them, so that a measurement that was stopped goes on where it was, and no figure of other
code stands in a table.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from numpy.typing import NDArray

from recon.capture.board_part import read_board
from recon.errors import InputError
from recon.files.code_digest import code_digest, is_unchanged
from recon.files.metrics import Metrics
from recon.optical_calibration.known_length import length_of, longest
from recon.probe_calibration import repeatability
from recon.probe_calibration.sound_in_water import speed_of_sound
from recon.session import optics_step, plan, probe_step
from sonotwin import choices, config, rendered_session
from sonotwin.choices import read_rig
from sonotwin.rendered_session import BOTTOM, SCAN, TUBE, WATER_C, WATER_SIGMA_M_S, WIRES, Settings
from sonotwin.verbs import reconstruct
from twin.conditions import speeds
from twin.evaluation import session_errors
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.kept_figures import Kept
from twin.ultrasound.timed_sweep import Clocks

Array = NDArray[np.float64]

SEEDS = tuple(range(721, 731))
BOARD_SCALE = {"ideal": 0.0, "lifelike": 3.0e-4}  # as a lab knows its board's print: exact, and of conf/conditions/lifelike.yaml
USUAL = "usual"  # a lab knows its board and tissue as they usually are
CERTIFIED = "certified"  # it had a length of its board measured, and the tissue's speed of sound
KNOWN = {"ideal": (USUAL,), "lifelike": (USUAL, CERTIFIED)}
LENGTH_SIGMA, SPEED_SIGMA_M_S = 2e-5, 5.0  # standard deviations of that length, relative, and of that speed
RIG = "meza2021"
POSES = "paper"  # of the board: 34, as in Meza et al. 2021
LENGTHS = ("tube_diameter_error_mm", "cover_diameter_error_mm", "cover_wall_error_mm")  # of the cylinders
MARK = "_true_extent_mm"  # of a tumour's figures, one a tumour
PACKAGES = ("recon", "scenes", "twin", "sonotwin")
TISSUE_M_S = 1450.0  # of the phantom's silicone
BOTTOM_HZ = 20.0  # pairs of frames over the flat bottom


def sessions(setup: Setup, conditions: str, known: str = USUAL, seeds: Sequence[int] = SEEDS) -> Figures:
    """Figures over sessions under one kind of conditions, by what the lab knows.

    Raises
    ------
    InputError
        For another rig than the default one: sessions are rendered by verbs, which read theirs from conf/rig; or where sessions
        of such conditions aren't reconstructed by what is `known`.
    """
    if setup.rig != read_rig(RIG):
        raise InputError(f"accuracy: rig: expected {RIG} for only=session, found another")
    if known not in KNOWN[conditions]:
        raise InputError(
            f"accuracy: known: expected one of {', '.join(KNOWN[conditions])} of {conditions} sessions, found {known}"
        )
    return together([measured(setup.out, conditions, known, seed) for seed in seeds])


def measured(out: Path | None, conditions: str, known: str, seed: int) -> Metrics:
    """Figures of one session, by estimated calibrations and tracked poses; those kept in a folder, if they are of this code.

    Raises
    ------
    InputError
        If code or settings were edited since this run took their digest, by which figures are kept.
    """
    kept = None if out is None else Kept(out / "session")
    keys = {each: f"{conditions}_{each}_{seed}_{code()}" for each in KNOWN[conditions]}
    if kept is not None and (there := kept.read(keys[known])) is not None:
        return there
    work = Path(mkdtemp(prefix="session"))
    try:
        found = session(work, conditions, seed)
    finally:
        shutil.rmtree(work)
    whole = {each: figures for each, (is_whole, figures) in found.items() if is_whole}
    if kept is not None and whole:
        if not is_unchanged(*PACKAGES, config.folder()):
            expected = "expected code and conf/ as they were when the run began, found them edited meanwhile"
            raise InputError(f"accuracy: {expected}; start it again, in a copy if you go on editing; what was kept before stays")
        kept.open()
        for each, figures in whole.items():
            kept.keep(keys[each], figures)
    return found[known][1]


def session(work: Path, conditions: str, seed: int) -> dict[str, tuple[bool, Metrics]]:
    """Render a session and the cylinders, take their truth away, reconstruct both by all that a lab may know, and compare.

    Returns, by what is known, whether all steps were done, and the figures.
    """
    chosen, captures = settings(conditions, seed), {name: work / name / "session" for name in ("scan", "cylinders")}
    for part in rendered_session.parts(chosen, captures["scan"], BOTTOM_HZ):
        part.run()
    for part in rendered_session.cylinders(chosen, captures["cylinders"]):
        part.run()
    truths = {name: (folder / "truth").rename(work / name / "truth") for name, folder in captures.items()}
    found = {}
    for known in KNOWN[conditions]:
        by = reconstruction(chosen, BOARD_SCALE[conditions], captures["scan"], work / "scan" / known)
        if known == CERTIFIED:
            by = certified(by, chosen, truths["scan"])
        status = reconstruct.run(by)
        figures = session_errors.measure(by.out, captures["scan"] / "capture", truths["scan"])
        if status == 0:
            in_tank = of_cylinders(by, captures["cylinders"], work / "cylinders" / known)
            status = reconstruct.run(in_tank)
            figures |= {} if status else session_errors.cylinders(in_tank.out, truths["cylinders"], TUBE)
        found[known] = status == 0, figures
    return found


def settings(conditions: str, seed: int) -> Settings:
    """A session's settings, which no default of the demonstration's changes; as many poses as in Meza et al. 2021."""
    groups = {"rig": RIG, "scene": "breast", "patterns": "paper_surface", "tracing": "default", "poses": POSES, "path": "raster"}
    groups |= {"ultrasound": "linear", "conditions": conditions}
    own = {"cameras": ["cam1", "cam2"], "shooting": {}, "clocks": Clocks(), "seed": seed, "out": "session"}
    longer = {"wires": 40, "bottom_s": 6.0, "board_samples": None}
    return Settings.model_validate({group: choices.read(group, name) for group, name in groups.items()} | own | longer)


def reconstruction(chosen: Settings, board_scale: float, session: Path, out: Path) -> reconstruct.Config:
    """Settings by which a session is reconstructed."""
    return reconstruct.Config(
        rig=chosen.rig,
        capture=session / "capture",
        out=out,
        board_scale=board_scale,
        temperature_c=WATER_C,
        tissue_m_s=TISSUE_M_S,
    )


def certified(by: reconstruct.Config, chosen: Settings, truth: Path) -> reconstruct.Config:
    """The same by a lab that measured the longest line of its board's points, and the speed of sound in the tissue."""
    rng, faster = np.random.default_rng([chosen.seed, 5]), speeds(chosen.conditions.sound, chosen.seed)[0]
    length = length_of(np.load(truth / "board.npz")["points"], longest(read_board(by.capture).board.points()))
    sigma = LENGTH_SIGMA * length
    known = {
        "board_length_mm": (length + sigma * rng.standard_normal(), sigma),
        "tissue_m_s": TISSUE_M_S * faster + SPEED_SIGMA_M_S * rng.standard_normal(),
        "tissue_sigma_m_s": SPEED_SIGMA_M_S,
    }
    return reconstruct.Config.model_validate(dict(by) | known)


def of_cylinders(by: reconstruct.Config, session: Path, out: Path) -> reconstruct.Config:
    """Settings by which the paper's cylinders are reconstructed, by the calibrations of a session."""
    lag = plan.read_lag(by.out / "latency")
    return reconstruct.Config(
        rig=by.rig,
        capture=session / "capture",
        out=out,
        find="tube",
        calibration=by.out / "optics" / optics_step.OPTICS,
        probe=by.out / "probe" / probe_step.PROBE,
        lag_s=lag.lag_s,
        lag_sigma_s=lag.sigma_s or 0.0,
        tissue_m_s=float(speed_of_sound(WATER_C)),
        tissue_sigma_m_s=WATER_SIGMA_M_S,
    )


def code() -> str:
    """Digest of the code and the settings that sessions are made by."""
    return code_digest(*PACKAGES, config.folder())


def together(found: Sequence[Metrics]) -> Figures:
    """Figures of some sessions, the worst of them unless the name says otherwise; NaN, which misses its bar, if one lacks it."""
    films = [f"{sweep}_track" for sweep in (WIRES, BOTTOM, SCAN)]
    tracked = [each(found, f"{film}_visible_found") / each(found, f"{film}_visible") for film in films]
    probe, sigma = each(found, f"{SCAN}_probe_worst_error_mm"), each(found, f"{SCAN}_probe_worst_sigma_mm")
    apart = np.array([each(found, f"{SCAN}_{figure}") for figure in session_errors.PROBE_ERRORS]).T.reshape(-1, 5, 3)
    several, contact = len(found) > 1, each(found, f"{SCAN}_contact_bias_mm")
    figures: Figures = {
        "sessions": len(found),
        "visible_percent": 100 * (each(found, f"{SCAN}_track_visible") / each(found, f"{SCAN}_track_frames")).min(),
        "tracked_percent": 100 * np.min(tracked),
        "false_poses": np.sum([each(found, f"{film}_false") for film in films]),
        "shift_mm": each(found, f"{SCAN}_track_shift_median_mm").max(),
        "shift_expected_mm": np.median(each(found, f"{SCAN}_track_shift_expected_mm")),
        "turn_deg": each(found, f"{SCAN}_track_turn_median_deg").max(),
        "latency_ms": np.abs(each(found, f"{SCAN}_lag_error_ms")).max(),
        "latency_covered_percent": 100 * each(found, f"{SCAN}_lag_covered").mean(),
        "probe_mm": probe.max(),
        "probe_over_sigma": rms(probe / sigma),
        "pixels_over_sigma": rms(each(found, f"{SCAN}_placement_over_sigma")),
        "contact_mm": abs(contact.mean()),
        "worst_contact_mm": np.abs(contact).max(),
    }
    figures["wall_over_sigma"] = rms(each(found, "cover_wall_error_mm") / each(found, "cover_wall_sigma_mm")) ** 2
    for name, measure in (("cr1", repeatability.between_pairs), ("cr2", repeatability.from_mean)):
        mm = measure(apart) if several else np.full(5, np.nan)
        figures |= {f"{name}_centre_mm": mm[0], f"{name}_corner_mm": mm[1:].max(), f"{name}_mean_mm": mm.mean()}
    for name in LENGTHS:
        errors = each(found, name)
        figures |= {name: np.abs(errors).max(), f"{name}_mean": errors.mean(), f"{name}_rms": rms(errors)}
        figures[f"{name}_spread"] = errors.std(ddof=1) if several else np.nan
    return figures | tumours(found)


def tumours(found: Sequence[Metrics]) -> Figures:
    """Figures of the tumours of some sessions."""
    names = sorted({key.removesuffix(MARK) for one in found for key in one if key.endswith(MARK)})

    def of(figure: str) -> Array:
        return np.array([each(found, f"{name}_{figure}") for name in names])

    inside = np.sum(of("inside") == 1, axis=0) - each(found, f"{SCAN}_tumours_false")
    volumes, depths = of("volume_mm3") / of("true_volume_mm3") - 1, of("under_skin_mm") - of("true_under_skin_mm")
    return {
        "tumours_inside": inside.min(),
        "centre_mm": np.max(of("centre_error_mm"), initial=0.0),
        "volume_percent": 100 * np.max(np.abs(volumes), initial=0.0),
        "tissue_mm": np.max(np.abs(depths), initial=0.0),
        "centre_over_sigma": rms(of("centre_error_mm") / of("centre_sigma_mm")),
        "volume_over_sigma": rms(volumes / (of("volume_sigma_mm3") / of("true_volume_mm3"))),
        "tissue_over_sigma": rms(depths / of("depth_sigma_mm")),
    }


def rms(values: Array) -> float:
    """Root mean square; NaN of none."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")


def each(found: Sequence[Metrics], figure: str) -> Array:
    """A figure of all sessions : (n,); NaN where one lacks it."""
    return np.array([one.get(figure, np.nan) for one in found], float)
