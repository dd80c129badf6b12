"""Experiments: what is measured of the twin and of the pipeline, from settings and seeds to figures, and their bars."""
