"""The simulated scanner: scatterers, surfaces, beams, B-mode images."""
