"""Accuracy of whole sessions: rendered, reconstructed from their images alone, and compared with the truth.

Each seed draws hand, light, speckle, noise and conditions anew. The figures of a seed are kept beside the tables, so that a
measurement that was stopped goes on where it was.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from recon.files import metrics
from recon.files.metrics import Metrics
from sonotwin import session_steps
from sonotwin.session_steps import BOTTOM, SCAN, WIRES
from twin.accuracy.table_rows import Measurement, Row, Setup
from twin.evaluation import session_errors, sweep_errors

SEEDS = tuple(range(701, 711))
WIDER = {"ideal": 1.0, "lifelike": 1.7}  # bars of each kind of conditions


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group: ten sessions under each kind of conditions."""
    return [lambda kind=kind: rows(kind, [measured(setup.out, kind, seed) for seed in SEEDS]) for kind in WIDER]


def measured(kept: Path | None, conditions: str, seed: int) -> Metrics:
    """Figures of one session, by estimated calibrations and tracked poses; from a folder of those kept, if they are there."""
    path = None if kept is None else kept / "session" / f"{conditions}_{seed}.json"
    if path is not None and path.is_file():
        return metrics.read(path)
    work = Path(mkdtemp(prefix="session"))
    try:
        figures = session(work, conditions, seed)
    finally:
        shutil.rmtree(work)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        metrics.write(path, figures)
    return figures


def session(work: Path, conditions: str, seed: int) -> Metrics:
    """Render a session, take its truth away, reconstruct, and compare."""
    given = [f"conditions={conditions}", f"seed={seed}"]
    for verb, fields in session_steps.rendering(work / "session", given):
        session_steps.do(verb, fields)
    truth = (work / "session" / "truth").rename(work / "truth")
    session_steps.do(*session_steps.reconstruction(work / "session", work / "result"))
    return session_errors.measure(work / "result", work / "session" / "capture", truth)


def rows(conditions: str, found: Sequence[Metrics]) -> list[Row]:
    """Rows of some sessions: the worst of them, unless it says otherwise."""
    wider, name = WIDER[conditions], f"{conditions}, {len(found)} sessions"
    seen = [one[f"{SCAN}_track_visible"] / one[f"{SCAN}_track_frames"] for one in found]
    films = [(one, f"{sweep}_track") for one in found for sweep in (WIRES, BOTTOM, SCAN)]
    tracked = [one[f"{film}_visible_found"] / one[f"{film}_visible"] for one, film in films]
    false = sum(one[f"{film}_false"] for one, film in films)
    probe = np.array([one[f"{SCAN}_probe_worst_error_mm"] for one in found])
    sigma = np.array([one[f"{SCAN}_probe_worst_sigma_mm"] for one in found])
    masses = [one[f"{SCAN}_tumours_found"] - one[f"{SCAN}_tumours_false"] - _each(one, "inside").count(0) for one in found]
    volumes, depths = _pairs(found, "volume_mm3"), _pairs(found, "under_skin_mm")
    contact = abs(float(np.mean([one[f"{SCAN}_contact_bias_mm"] for one in found])))
    return [
        Row("a", f"{name}: frames that show the whole target to both", 100 * min(seen), 90.0, None, "%", at_least=True),
        Row("b", f"{name}: found, of pairs that show the target whole", 100 * min(tracked), 99.0, None, "%", at_least=True),
        Row("b", f"{name}: wrong poses in all sweeps", false, 0.0, 0.0, "poses"),
        Row("b", f"{name}: translation in the scan, median", _worst(found, "track_shift_median_mm"), 0.03 * wider, None, "mm"),
        Row("b", f"{name}: rotation in the scan, median", _worst(found, "track_turn_median_deg"), 0.05 * wider, None, "deg"),
        Row("c", f"{name}: latency", _worst(found, "lag_error_ms"), 1.5 * wider, None, "ms"),
        Row("c", f"{name}: latency within its 95 % interval", 100 * _mean(found, "lag_covered"), 80.0, 95.0, "%", at_least=True),
        Row("d", f"{name}: probe, the worst of five pixels", probe.max(), 0.20 * wider, None, "mm"),
        Row("d", f"{name}: the same over its predicted sigma, RMS", float(np.sqrt(np.mean((probe / sigma) ** 2))), None, 1.0, ""),
        Row("f", f"{name}: tumours found inside the skin, less false ones, of 3", min(masses), 3.0, 3.0, "", at_least=True),
        Row("f", f"{name}: tumours' centres", max(max(_each(one, "centre_error_mm")) for one in found), 0.35 * wider, None, "mm"),
        Row("f", f"{name}: tumours' volumes", np.max([100 * abs(a / b - 1) for a, b in volumes]), 6.0 * wider, None, "%"),
        Row("f", f"{name}: least tissue over tumours", np.max([abs(a - b) for a, b in depths]), 0.25 * wider, None, "mm"),
        Row("g", f"{name}: array's face from the skin by light, mean", contact, 0.05 * wider, None, "mm"),
        Row("g", f"{name}: the same, worst", _worst(found, "contact_bias_mm"), None, None, "mm"),
    ]  # fmt: skip


def _pairs(found: Sequence[Metrics], figure: str) -> list[tuple[float, float]]:
    """A figure of all tumours beside the true one; NaN of those that weren't found."""
    mark = "_true_extent_mm"
    names = [(one, key.removesuffix(mark)) for one in found for key in one if key.endswith(mark)]
    return [(one[f"{name}_{figure}"], one[f"{name}_true_{figure}"]) for one, name in names]


def _each(one: Metrics, figure: str) -> list[float]:
    """A figure of all tumours that were found."""
    own = {key.removeprefix(f"{SCAN}_"): value for key, value in one.items() if key.startswith(f"{SCAN}_")}
    return sweep_errors.of_each(own, figure)


def _worst(found: Sequence[Metrics], figure: str) -> float:
    return max(abs(one[f"{SCAN}_{figure}"]) for one in found)


def _mean(found: Sequence[Metrics], figure: str) -> float:
    return float(np.mean([one[f"{SCAN}_{figure}"] for one in found]))
