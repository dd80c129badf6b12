"""Accuracy of ultrasound: B-mode physics, probe calibration, clocks, objects found in sweeps, and recordings of others."""

from twin.experiments import bmode_accuracy, clock_accuracy, mass_accuracy, probe_accuracy, recorded_sequences, tube_accuracy
from twin.experiments.table_rows import Measurement, Setup


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group, at full size; rows of recordings only where they are at hand."""
    known = setup.real is not None
    return [
        *bmode_accuracy.measurements(setup),
        *probe_accuracy.measurements(setup),
        lambda: clock_accuracy.rows(setup),
        lambda: tube_accuracy.rows(setup),
        lambda: mass_accuracy.rows(setup),
        *([lambda: recorded_sequences.real_sweep(setup)] if known else []),
        recorded_sequences.round_trip,
        recorded_sequences.damaged,
        *([lambda: recorded_sequences.real_file(setup)] if known else []),
    ]
