"""Capture folders and calibration files, read and written."""
