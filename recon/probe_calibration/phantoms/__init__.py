"""Phantoms that a probe is calibrated by: each shows one point at rest. Each module is one, named as `phantom` of a calibration.

A module has `find(image, appearance)`: the `Crossing` of that point in a B-scan : (h, w), 8-bit grey levels, log-compressed, with
its covariance, or the reason of its rejection. `appearance` is an `Appearance` on the scanner, or None.
"""
