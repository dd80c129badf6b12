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

from recon.errors import InputError
from recon.files import metrics
from recon.files.code_digest import code_digest
from recon.files.metrics import Metrics, shown
from recon.probe_calibration import repeatability
from recon.probe_calibration.sound_in_water import speed_of_sound
from recon.session import optics_step, plan, probe_step
from sonotwin import choices, config, rendered_session
from sonotwin.choices import read_rig
from sonotwin.rendered_session import BOTTOM, SCAN, TUBE, WATER_C, WATER_SIGMA_M_S, WIRES, Settings
from sonotwin.verbs import reconstruct
from twin.evaluation import session_errors
from twin.experiments.table_rows import Measurement, Row, Setup
from twin.ultrasound.timed_sweep import Clocks

Array = NDArray[np.float64]

SEEDS = tuple(range(721, 731))
BOARD_SCALE = {"ideal": 0.0, "lifelike": 3.0e-4}  # as a lab knows its board's print: exact, and of conf/conditions/lifelike.yaml
WIDER = {"ideal": 1.0, "lifelike": 1.7}  # bars of each kind of conditions
RIG = "meza2021"
POSES = "paper"  # of the board: 34, as in Meza et al. 2021
CR1_MM, CR2_MM = (0.12, 0.16, 0.15), (0.08, 0.11, 0.10)  # bars: centre, corners, mean
LENGTHS = {  # of the cylinders: figure, what it is the error of, its bar and the paper's, mm
    "tube_diameter_error_mm": ("inner cylinder's diameter by ultrasound", 0.06, 0.72),
    "cover_diameter_error_mm": ("outer cylinder's diameter by light", 0.03, 0.10),
    "cover_wall_error_mm": ("distance of their walls by both", 0.06, 0.12),
}
MARK = "_true_extent_mm"  # of a tumour's figures, one a tumour
PACKAGES = ("recon", "scenes", "twin", "sonotwin")
TISSUE_M_S = 1450.0  # of the phantom's silicone
BOTTOM_HZ = 20.0  # pairs of frames over the flat bottom


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group: ten sessions under each kind of conditions.

    Raises
    ------
    InputError
        For another rig than the default one: sessions are rendered by verbs, which read theirs from conf/rig.
    """
    if setup.rig != read_rig(RIG):
        raise InputError(f"accuracy: rig: expected {RIG} for only=session, found another")
    return [lambda kind=kind: rows(kind, [measured(setup.out, kind, seed) for seed in SEEDS]) for kind in WIDER]


def measured(kept: Path | None, conditions: str, seed: int) -> Metrics:
    """Figures of one session, by estimated calibrations and tracked poses; those kept in a folder, if they are of this code."""
    path = None if kept is None else kept / "session" / f"{conditions}_{seed}_{code()}.json"
    if path is not None and path.is_file():
        return metrics.read(path)
    work = Path(mkdtemp(prefix="session"))
    try:
        whole, figures = session(work, conditions, seed)
    finally:
        shutil.rmtree(work)
    if path is not None and whole:
        path.parent.mkdir(parents=True, exist_ok=True)
        metrics.write(path, figures)
    return figures


def session(work: Path, conditions: str, seed: int) -> tuple[bool, Metrics]:
    """Render a session, take its truth away, reconstruct, and compare; then the cylinders by its calibrations.

    Returns whether all steps were done, and the figures.
    """
    chosen = settings(conditions, seed)
    for part in rendered_session.parts(chosen, work / "session", BOTTOM_HZ):
        part.run()
    truth = (work / "session" / "truth").rename(work / "truth")
    by = reconstruction(chosen, BOARD_SCALE[conditions], work / "session", work / "result")
    status = reconstruct.run(by)
    figures = session_errors.measure(work / "result", work / "session" / "capture", truth)
    if status:
        return False, figures
    status, of_cylinders = cylinders(work / "cylinders", chosen, by)
    return status == 0, figures | of_cylinders


def settings(conditions: str, seed: int) -> Settings:
    """A session's settings, which no default of the demonstration's changes; as many poses as in Meza et al. 2021."""
    groups = {"rig": RIG, "scene": "breast", "patterns": "paper_surface", "tracing": "default", "poses": POSES, "path": "raster"}
    groups |= {"ultrasound": "linear", "conditions": conditions}
    own = {"cameras": ["cam1"], "shooting": {}, "clocks": Clocks(), "wires": 40, "bottom_s": 6.0, "seed": seed, "out": "session"}
    return Settings.model_validate({group: choices.read(group, name) for group, name in groups.items()} | own)


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


def cylinders(work: Path, chosen: Settings, by: reconstruct.Config) -> tuple[int, Metrics]:
    """The paper's cylinders by the calibrations of a session; returns the exit status of `reconstruct`, and the figures."""
    for part in rendered_session.cylinders(chosen, work / "session"):
        part.run()
    truth = (work / "session" / "truth").rename(work / "truth")
    lag = plan.measured_lag(by.out / "latency")
    in_tank = reconstruct.Config(
        rig=chosen.rig,
        capture=work / "session" / "capture",
        out=work / "result",
        find="tube",
        calibration=by.out / "optics" / optics_step.OPTICS,
        probe=by.out / "probe" / probe_step.PROBE,
        lag_s=lag.lag_s,
        lag_sigma_s=lag.sigma_s or 0.0,
        tissue_m_s=float(speed_of_sound(WATER_C)),
        tissue_sigma_m_s=WATER_SIGMA_M_S,
        board_scale=by.board_scale,
    )
    status = reconstruct.run(in_tank)
    return status, {} if status else session_errors.cylinders(work / "result", truth, TUBE)


def code() -> str:
    """Digest of the code and the settings that sessions are made by."""
    return code_digest(*PACKAGES, config.folder())


def rows(conditions: str, found: Sequence[Metrics]) -> list[Row]:
    """Rows of some sessions: the worst of them, unless it says otherwise; NaN, which misses its bar, of what is missing."""
    wider, name = WIDER[conditions], f"{conditions}, {len(found)} session{'' if len(found) == 1 else 's'}"
    films = [f"{sweep}_track" for sweep in (WIRES, BOTTOM, SCAN)]
    seen = each(found, f"{SCAN}_track_visible") / each(found, f"{SCAN}_track_frames")
    tracked = np.array([each(found, f"{film}_visible_found") / each(found, f"{film}_visible") for film in films])
    false = np.sum([each(found, f"{film}_false") for film in films])
    probe, sigma = each(found, f"{SCAN}_probe_worst_error_mm"), each(found, f"{SCAN}_probe_worst_sigma_mm")
    names = sorted({key.removesuffix(MARK) for one in found for key in one if key.endswith(MARK)})
    inside = np.sum([each(found, f"{name}_inside") == 1 for name in names], axis=0) - each(found, f"{SCAN}_tumours_false")
    centres = np.array([each(found, f"{name}_centre_error_mm") for name in names])
    volumes = np.array([each(found, f"{name}_volume_mm3") / each(found, f"{name}_true_volume_mm3") - 1 for name in names])
    depths = np.array([each(found, f"{name}_under_skin_mm") - each(found, f"{name}_true_under_skin_mm") for name in names])
    placed = each(found, f"{SCAN}_placement_over_sigma")
    sigmas = np.array([each(found, f"{name}_centre_sigma_mm") for name in names])
    deep = np.array([each(found, f"{name}_depth_sigma_mm") for name in names])
    swollen = np.array([each(found, f"{name}_volume_sigma_mm3") / each(found, f"{name}_true_volume_mm3") for name in names])
    contact, lag = each(found, f"{SCAN}_contact_bias_mm"), each(found, f"{SCAN}_lag_error_ms")
    shift, turn = each(found, f"{SCAN}_track_shift_median_mm"), each(found, f"{SCAN}_track_turn_median_deg")
    covered = 100 * each(found, f"{SCAN}_lag_covered").mean()
    apart = np.array([each(found, f"{SCAN}_{figure}") for figure in session_errors.PROBE_ERRORS]).T.reshape(-1, 5, 3)
    several, none = len(found) > 1, np.full(5, np.nan)
    return [
        Row("a", f"{name}: frames that show the whole target to both", 100 * seen.min(), 90.0, None, "%", at_least=True),
        Row("b", f"{name}: found, of pairs that show the target whole", 100 * tracked.min(), 99.0, None, "%", at_least=True),
        Row("b", f"{name}: wrong poses in all sweeps", float(false), 0.0, 0.0, "poses"),
        Row("b", f"{name}: translation in the scan, median", shift.max(), 0.03 * wider, None, "mm"),
        Row("b", f"{name}: rotation in the scan, median", turn.max(), 0.05 * wider, None, "deg"),
        Row("c", f"{name}: latency", np.abs(lag).max(), 1.5 * wider, None, "ms"),
        Row("c", f"{name}: latency within its 95 % interval", covered, 80.0, 95.0, "%", at_least=True),
        Row("d", f"{name}: probe, the worst of five pixels", probe.max(), 0.20 * wider, None, "mm"),
        Row("d", f"{name}: the same over its predicted sigma, RMS", np.sqrt(np.mean((probe / sigma) ** 2)), None, 1.0, ""),
        *repeated("CR1", name, repeatability.between_pairs(apart) if several else none, CR1_MM, wider),
        *repeated("CR2", name, repeatability.from_mean(apart) if several else none, CR2_MM, wider),
        *[cylinder(figure, name, each(found, figure), wider) for figure in LENGTHS],
        Row("f", f"{name}: tumours found inside the skin, less false ones, of 3", inside.min(), 3.0, 3.0, "", at_least=True),
        Row("f", f"{name}: tumours' centres", np.max(centres, initial=0.0), 0.35 * wider, None, "mm"),
        Row("f", f"{name}: tumours' volumes", 100 * np.max(np.abs(volumes), initial=0.0), 6.0 * wider, None, "%"),
        Row("f", f"{name}: least tissue over tumours", np.max(np.abs(depths), initial=0.0), 0.25 * wider, None, "mm"),
        Row("s", f"{name}: places of pixels over their predicted sigma, RMS", rms(placed), 2.0, 1.0, ""),
        Row("s", f"{name}: tumours' centres over their predicted sigma, RMS", rms(centres / sigmas), 2.0, 1.0, ""),
        Row("s", f"{name}: tumours' volumes over theirs, RMS", rms(volumes / swollen), 2.0, 1.0, ""),
        Row("s", f"{name}: least tissue over tumours over its, RMS", rms(depths / deep), 2.0, 1.0, ""),
        Row("g", f"{name}: array's face from the skin by light, mean", abs(contact.mean()), 0.05 * wider, None, "mm"),
        Row("g", f"{name}: the same, worst", np.abs(contact).max(), None, None, "mm"),
    ]  # fmt: skip


def repeated(measure: str, name: str, mm: Array, bars: tuple[float, float, float], wider: float) -> list[Row]:
    """Repeatability over sessions : (5,) mm, at the centre, the worst corner, and in the mean."""
    found = {"centre": mm[0], "worst corner": mm[1:].max(), "mean of five pixels": mm.mean()}
    return [
        Row("d", f"{name}: probe, {measure}, {place}", float(value), bar * wider, None, "mm")
        for (place, value), bar in zip(found.items(), bars, strict=True)
    ]


def cylinder(figure: str, name: str, errors: Array, wider: float) -> Row:
    """Errors of a length of the cylinders over sessions : (n,) mm: the worst, with mean and spread."""
    what, bar, paper = LENGTHS[figure]
    spread = errors.std(ddof=1) if len(errors) > 1 else np.nan
    text = f"{name}: {what} (mean {errors.mean():+.3f}, spread {shown(spread, '.3f')}; paper: {paper:.2f})"
    return Row("e", text, float(np.abs(errors).max()), bar * wider, None, "mm")


def rms(values: Array) -> float:
    """Root mean square; NaN of none."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")


def each(found: Sequence[Metrics], figure: str) -> Array:
    """A figure of all sessions : (n,); NaN where one lacks it."""
    return np.array([one.get(figure, np.nan) for one in found], float)
