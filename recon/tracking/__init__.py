"""Optical tracking of the probe by its planar target of circles."""
