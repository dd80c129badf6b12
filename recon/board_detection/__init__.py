"""Calibration boards in images: discs and corners, to a hundredth of a pixel."""
