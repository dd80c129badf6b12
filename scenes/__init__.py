"""Everything that stands in front of the instruments: meshes, materials, acoustics."""
