"""Skin by light and masses by ultrasound in one frame: layers, a page, a folder for 3D Slicer."""
