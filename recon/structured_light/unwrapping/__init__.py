"""Spatial phase unwrapping from a projected centre line."""
