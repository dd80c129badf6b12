"""Rivals for measurements only: published recipe, thresholds, marker boards, OpenCV."""
