"""Forms of masses, by the words of BI-RADS: closed, star-shaped, of an exact size."""

from typing import Literal

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from scenes.noise import smooth_noise
from scenes.tumour import caliper, golden_spiral, tumour

MassForm = Literal["round", "oval", "lobulated", "irregular", "spiculated"]
CIRCUMSCRIBED: tuple[MassForm, ...] = ("round", "oval", "lobulated")
"""forms with an even border, which shines where sound meets it squarely; others have no rim"""


def mass(form: MassForm, size_mm: float, rng: np.random.Generator) -> trimesh.Trimesh:
    """A mass about the origin, whose greatest extent in any direction is exactly `size_mm`."""
    if form == "lobulated":
        return tumour(size_mm, rng)
    sphere = trimesh.creation.icosphere(subdivisions=5)  # edges of 0.04 of the radius
    directions = sphere.vertices
    match form:
        case "round":
            radius, aspect = 1 + 0.02 * smooth_noise(directions, 1.5, rng), (1.0, 0.95, 0.92)
        case "oval":
            uneven = 0.03 * smooth_noise(directions, 1.5, rng) + 0.025 * smooth_noise(directions, 0.6, rng)
            radius, aspect = 1 + uneven + 0.008 * smooth_noise(directions, 0.25, rng), (1.0, 0.75, 0.6)
        case "irregular":
            uneven = 0.16 * smooth_noise(directions, 1.3, rng) + 0.06 * smooth_noise(directions, 0.6, rng)
            radius, aspect = np.exp(uneven + 0.012 * smooth_noise(directions, 0.3, rng)), (1.0, 0.9, 0.8)
        case "spiculated":
            radius, aspect = np.exp(0.15 * smooth_noise(directions, 1.0, rng)) + _spikes(directions, rng), (1.0, 0.95, 0.9)
    vertices = Rotation.random(rng=rng).apply(radius[:, None] * directions * aspect)
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return trimesh.Trimesh(vertices * (size_mm / caliper(vertices)), sphere.faces, process=False)


def _spikes(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Heights of spikes over a body of radius 1, in some 20 directions: half as high at 6 deg."""
    count = int(rng.integers(16, 25))
    axes = golden_spiral(count) + 0.2 * rng.standard_normal((count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.exp(120.0 * (directions @ axes.T - 1)) @ rng.uniform(0.3, 0.9, count)
