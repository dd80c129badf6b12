"""Lobulated tumours: closed, star-shaped, of an exact size."""

from functools import cache

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
    """Greatest distance between two of the points : (n, 3), in their unit.

    A pair at distance L reaches along the nearest of many lines by L cos(a) at least, a being the greatest angle to it. Tried are
    the lines along which the points reach as far as that, for an L that some pair has, and on each those so near to either end.
    """
    lines, cosine = _lines()
    outer = points[ConvexHull(points).vertices]
    along = lines @ outer.T
    spans = outer[along.argmax(axis=1)] - outer[along.argmin(axis=1)]
    least = cosine * np.linalg.norm(spans, axis=1).max() * (1 - 1e-9)  # for rounding
    tried = along[np.ptp(along, axis=1) >= least]
    return float(max(pdist(outer[(line >= line.min() + least) | (line <= line.max() - least)]).max() for line in tried))


@cache
def _lines() -> tuple[np.ndarray, float]:
    """Directions : (321, 3) of lines, evenly in space, and the cosine of the greatest angle from any direction to the nearest."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    cosine = (sphere.face_normals * sphere.vertices[sphere.faces[:, 0]]).sum(axis=1).min()  # to the middle of the widest facet
    return np.array(sphere.vertices[sphere.vertices @ [1, 0.1, 0.01] > 0]), float(cosine)
