"""Fringe projection: from images of a pattern sequence to points and meshes."""
