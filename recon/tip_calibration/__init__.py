"""Calibration of a tracked tool's tip in the frame of its target, by turning the tool about it, and of its shaft's direction."""
