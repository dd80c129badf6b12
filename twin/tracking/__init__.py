"""Frames of the tracking cameras: a held probe with its target over surroundings, as training data with ground truth."""

from twin.llvm import load_mitsuba

load_mitsuba()
