"""Rigid motions, cameras, ellipses and primitives: geometry without files."""
