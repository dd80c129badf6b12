"""How true ultrasound is: B-mode physics, probe calibration, clocks, objects found in sweeps, and recordings of others."""

from twin.accuracy import bmode, clocks, masses, probe, recordings, tube
from twin.accuracy.rows import Measurement, Setup


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group, at full size; rows of recordings only where they are at hand."""
    known = setup.real is not None
    return [
        *bmode.measurements(setup),
        *probe.measurements(setup),
        lambda: clocks.rows(setup),
        lambda: tube.rows(setup),
        lambda: masses.rows(setup),
        *([lambda: recordings.real_sweep(setup)] if known else []),
        recordings.round_trip,
        recordings.damaged,
        *([lambda: recordings.real_file(setup)] if known else []),
    ]
