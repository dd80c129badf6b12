"""Clips of B-scans as scanners and frame grabbers leave them, and other trackers' tables of poses."""
