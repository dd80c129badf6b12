"""Lobulated tumours: closed, star-shaped, of an exact size."""

import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation


def tumour(size_mm: float, rng: np.random.Generator) -> trimesh.Trimesh:
    """A lobulated mass about the origin, whose greatest extent in any direction is exactly `size_mm`.

    Its radius is `1 + sum_k h_k exp(s (d . d_k - 1))` in direction d: bumps (von Mises-Fisher lobes) in directions d_k that are
    spread over the sphere, on a golden spiral with some scatter, so that hollows stay between them.
    """
    subdivisions = 4  # of the icosphere: 2562 vertices, edges of 0.5 to 1.2 mm
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    directions = sphere.vertices
    lobes = (7, 10)  # fewest and most
    count = rng.integers(lobes[0], lobes[1] + 1)
    lobe_scatter = 0.25  # standard deviation of lobes from an even spread, rad
    axes = golden_spiral(int(count)) + lobe_scatter * rng.standard_normal((count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    lobe_height = (0.22, 0.42)  # of the body's radius
    heights = rng.uniform(*lobe_height, count)
    lobe_sharpness = 12.0  # concentration of a lobe about its direction: half height at 20 deg
    radius = 1 + np.exp(lobe_sharpness * (directions @ axes.T - 1)) @ heights
    aspect = (1.0, 0.88, 0.78)  # of the body beneath the lobes; masses are seldom round
    vertices = Rotation.random(rng=rng).apply(radius[:, None] * directions * aspect)
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return trimesh.Trimesh(vertices * (size_mm / caliper(vertices)), sphere.faces, process=False)


def golden_spiral(count: int) -> np.ndarray:
    """Unit vectors : (count, 3) spread evenly over the sphere."""
    index = np.arange(count)
    z = 1 - (2 * index + 1) / count
    turn = np.pi * (1 + np.sqrt(5)) * index
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


def caliper(points: np.ndarray) -> float:
    """Greatest distance between two of the points : (n, 3), in their unit."""
    radii = np.linalg.norm(points - (points.min(axis=0) + points.max(axis=0)) / 2, axis=1)
    least, end = 0.0, radii.argmax()
    for _ in range(3):  # there and back
        away = np.linalg.norm(points - points[end], axis=1)
        least, end = max(least, float(away.max())), away.argmax()
    ends = points[radii >= least - radii.max() - 1e-9 * least]  # two points are no farther apart than the sum of their radii
    many = 500  # of which a hull takes less time than all pairs
    return float(pdist(ends[ConvexHull(ends).vertices] if len(ends) > many else ends).max())
