"""Trials of patterns on images: the likely sequence where the given one contradicts them."""
