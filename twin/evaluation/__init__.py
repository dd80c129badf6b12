"""Errors of surfaces, sweeps and tracks against the ground truth."""
