"""Two wires that cross, as in Meza et al. 2021: a spot, or the meeting of two lines; see `cross_wire`."""

from numpy.typing import NDArray

from recon.probe_calibration import cross_wire
from recon.probe_calibration.cross_wire import Appearance, Crossing
from recon.probe_calibration.point_phantom import MIN_FRAMES, SHOWS, WAYS, calibrate, describe, figures, misfit, read, sight

__all__ = ["MIN_FRAMES", "SHOWS", "WAYS", "calibrate", "describe", "figures", "find", "misfit", "read", "sight"]


def find(image: NDArray, appearance: Appearance | None, known: None) -> Crossing:
    """Find the crossing."""
    del known
    return cross_wire.find(image, appearance)
