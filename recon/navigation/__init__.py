"""Live navigation: the probe tracked, its B-scans in place, skin and masses around them; for a page and for 3D Slicer."""
