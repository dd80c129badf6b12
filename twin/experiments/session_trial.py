"""Rigs drawn at random and identified from their captures: CR1 and masses' errors as their twins predict them, and as found.

The identified twin rehearses the session: its probe is calibrated, and masses are swept. The true rig then films calibrations
and sweeps, which are tracked by its identified optics and read by the very software, each sweep by several calibrations.
Nothing of the true rig's truth is in the prediction. Wires and masses are those of a phantom: their forms are alike in both,
hands and speckle are others.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from recon.files.metrics import Metrics
from recon.model.rig import Probe, Rig
from recon.session.rig_step import Identification
from scenes.board_poses import Config as BoardPoses
from twin.evaluation.surface_errors import rms
from twin.experiments import drawn_rig, identify_trial, predicted_session, rehearsal
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.rehearsal import Rehearsed, Stage, Wires
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

COLUMNS = 256  # of the drawn scanners' images, 20 to 36 mm, which whole masses fit into
CALIBRATIONS = 8  # of the true rig, and of its twin
READ_BY = 4  # of them each sweep of the true rig is read by
SWEPT_BY_TWIN = 3
SESSIONS = 24  # drawn, for the place of a mass
EXACT = ("latency", "crossing", "beside", "circle_at_wires", "bracket_at_wires")  # in these
OTHER_SEED = 10_000  # added for the true rig: another hand, other speckle


def measure(settings: Settings, seed: int) -> Metrics:
    """Predicted and found CR1, and errors of masses, of one rig."""
    rig, conditions = drawn_rig.draw(settings.rig, seed)
    array = drawn_rig.draw_scanner(np.random.default_rng([seed, 61]))
    array = array.model_copy(update={"image_size": (COLUMNS, array.image_size[1])})
    rig = identify_trial.with_scanner(rig, array)
    with TemporaryDirectory() as folder:
        found = identify_trial.identify_recorded(rig, conditions, array, Path(folder), settings.poses.seed + seed, seed)
    return compare(settings, rig, array, found, seed)


def compare(settings: Settings, rig: Rig, array: Transducer, identified: Identification, seed: int) -> Metrics:
    """The same of a rig that has been identified."""
    assert identified.scanner is not None
    scanner = Transducer.model_validate(identified.scanner.description)
    twin = _of(settings, identified.rig, scanner)
    rehearsed = rehearsal.rehearse(twin, CALIBRATIONS, SWEPT_BY_TWIN, seed)
    true = Stage(_of(settings, rig, array), identified.rig.calibration(), scanner.dynamic_range_db, seed + OTHER_SEED)
    wires = rehearsal.calibrate(true, CALIBRATIONS)
    probes = [one.calibration for one in wires.results]
    read_by = [probes[first : first + READ_BY] for first in range(0, CALIBRATIONS, READ_BY)]
    masses = rehearsal.joined([rehearsal.segmented(true, number, each) for number, each in enumerate(read_by)])
    return (
        repeatabilities(rehearsed, wires, rig.probe)
        | compare_errors("volume_percent", 100 * rehearsed.masses.volume, 100 * masses.volume)
        | compare_errors("centre_mm", rehearsed.masses.centre_mm, masses.centre_mm, placed(twin, rehearsed))
    )


def _of(settings: Settings, rig: Rig, scanner: Transducer) -> Settings:
    """A rig in the session, with the board's poses by which it was identified."""
    poses = BoardPoses(count=identify_trial.POSES, seed=settings.poses.seed)
    return settings.model_copy(update={"rig": rig, "ultrasound": scanner, "poses": poses})


def placed(twin: Settings, rehearsed: Rehearsed) -> float:
    """RMS error, mm, of the place of a mass by one calibration of the probe, by the optics, and by tracking.

    The last two are of drawn sessions with the twin's noise, in which the probe errs by nothing else.
    """
    noise = rehearsal.noise_of(twin, rehearsed.wires)
    exact = noise.drawn.model_copy(update=dict.fromkeys(EXACT, 0.0))
    drawn = predicted_session.predict(
        twin.model_copy(update={"noise": noise.model_copy(update={"drawn": exact})}), range(SESSIONS)
    )
    return float(np.hypot(rehearsed.place_mm, drawn["mass_error_mm"].rms))


def repeatabilities(rehearsed: Rehearsed, found: Wires, probe: Probe) -> Metrics:
    """CR1 as predicted, as found by mixtures of the true rig's calibrations, and of these few themselves; what detectors found.

    Held is the CR1 of the few if it is within 95 % of their scatter and of the prediction's own.
    """
    mixed = rehearsal.repeatability_of(rehearsal.mixtures(found.sightings, probe), len(found.results), probe.image_size)
    few = rehearsal.cr1([one.adjustment.calibration for one in found.results][: rehearsal.FEW], probe.image_size)
    predicted = rehearsed.repeatability
    scatter = float(np.hypot(predicted.of_few, predicted.known))
    figures: Metrics = {"cr1_predicted_mm": predicted.mm, "cr1_found_mm": mixed.mm, "cr1_of_few_mm": few}
    figures |= {"cr1_predicted_over_found": predicted.mm / mixed.mm, "cr1_predicted_over_few": predicted.mm / few}
    figures |= {"cr1_scatter": scatter, "cr1_held": int(abs(few / predicted.mm - 1) < 1.96 * scatter)}
    for name in rehearsal.Seen._fields:
        figures |= {f"{name}_twin": getattr(rehearsed.wires.seen, name), f"{name}_found": getattr(found.seen, name)}
    return figures


def compare_errors(name: str, predicted: Array, found: Array, besides: float = 0.0) -> Metrics:
    """RMS errors of masses, (m,) or vectors (m, 3), as predicted, with what adds to these besides, and as found; NaN of none."""
    sizes = [np.linalg.norm(each.reshape(len(each), -1), axis=1) for each in (predicted, found)]
    by_twin, by_rig = (rms(each[np.isfinite(each)]) if np.isfinite(each).any() else np.nan for each in sizes)
    by_twin = float(np.hypot(by_twin, besides))
    figures: Metrics = {f"{name}_found": by_rig, f"{name}_predicted": by_twin, f"{name}_predicted_over_found": by_twin / by_rig}
    return figures | {
        f"{name}_masses_twin": int(np.isfinite(sizes[0]).sum()),
        f"{name}_masses_found": int(np.isfinite(sizes[1]).sum()),
    }


RATIOS = ("cr1", "volume_percent", "centre_mm")
EXPERIMENT = Experiment(
    ("rig", "poses", "film.white_dn", "wire_path", "ranges", "noise"),
    measure,
    {f"{name}_predicted_over_found": "" for name in RATIOS},
    counts=("cr1_held",),
)
