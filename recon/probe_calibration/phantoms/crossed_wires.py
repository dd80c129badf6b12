"""Two wires that cross, as in Meza et al. 2021: a spot, or the meeting of two lines; see `cross_wire`."""

from recon.probe_calibration.cross_wire import find

__all__ = ["find"]
