"""Guidance of whoever holds the calibration board: where to hold it next, and whether a pose is worth keeping."""
