"""Guided recording of surfaces, boards and sweeps: what is wrong with a frame, and how to mend it."""
