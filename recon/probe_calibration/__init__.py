"""Calibration of the ultrasound probe: in space by crossed wires, in time by a flat bottom."""
