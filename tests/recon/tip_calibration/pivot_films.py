"""A tool that pivots in a dimple: its true motion, and what a tracker with errors of a known covariance says of it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.model.tracks import Track

DIMPLE = np.array([12.0, -25.0, 690.0])  # mm, in the world
UP = np.array([0.0, -0.35, -0.94]) / np.linalg.norm([0.0, -0.35, -0.94])  # towards the cameras, in which the shaft stands
PERIOD_NS = 33_333_333


@dataclass(frozen=True)
class Tool:
    """A needle with its target beside the shaft."""

    tip: np.ndarray  # (3,) mm, in the target's frame
    axis: np.ndarray  # (3,) unit, from the handle to the tip


def draw_tool(rng, length=(100.0, 250.0)) -> Tool:
    """The tip as far away as asked for, the shaft within 20 degrees of the way there."""
    way = rng.standard_normal(3)
    way /= np.linalg.norm(way)
    aside = np.cross(way, rng.standard_normal(3))
    axis = Rotation.from_rotvec(np.radians(rng.uniform(0, 20)) * aside / np.linalg.norm(aside)).apply(way)
    return Tool(rng.uniform(*length) * way, axis)


def turns(tool: Tool, rng, count=200, tilt_deg=35.0, roll_deg=40.0, plane=False) -> np.ndarray:
    """Rotations world_from_target : (n, 3, 3) of a hand that leads the shaft about the upright to all sides, or in one plane."""
    seconds = np.arange(count) / 30
    to_all = [np.sin(2 * np.pi * rng.uniform(0.25, 0.6) * seconds + rng.uniform(0, 2 * np.pi)) for _ in range(3)]
    tilts = np.radians(tilt_deg) * np.column_stack(to_all[:2]) / np.sqrt(2) * [1, 0 if plane else 1]
    roll = np.radians(roll_deg) * to_all[2] * (not plane)
    first = np.cross(UP, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    upright = Rotation.align_vectors([-UP], [tool.axis])[0] * Rotation.from_rotvec(rng.uniform(0, 2 * np.pi) * tool.axis)
    spun = Rotation.from_rotvec(roll[:, None] * -UP)
    leant = Rotation.from_rotvec(tilts @ np.array([first, np.cross(UP, first)]))
    return (leant * spun * upright).as_matrix()


def poses_of(rotations, tips, dimples=DIMPLE) -> np.ndarray:
    """Poses : (n, 4, 4) that hold tips : (3,) or (n, 3) mm of the target's frame at dimples : (3,) or (n, 3) mm."""
    result = np.tile(np.eye(4), (len(rotations), 1, 1))
    result[:, :3, :3] = rotations
    result[:, :3, 3] = dimples - np.einsum("nij,nj->ni", rotations, np.broadcast_to(tips, (len(rotations), 3)))
    return result


def draw_covariance(rng, sigma_mm, sigma_deg) -> np.ndarray:
    """A covariance : (6, 6) of a turn and a shift with these standard deviations over all directions."""
    scale = np.repeat([1.0, 1.0], 3) * np.array([1.0, 1.2, 0.6, 0.4, 0.4, 1.0])
    root = scale[:, None] * (np.eye(6) + 0.35 * rng.standard_normal((6, 6)))
    covariance = root @ root.T
    for part, sigma in ((slice(0, 3), np.radians(sigma_deg)), (slice(3, 6), sigma_mm)):
        factor = sigma / np.sqrt(np.trace(covariance[part, part]))
        covariance[part] *= factor
        covariance[:, part] *= factor
    return covariance


def tracked(poses, rng, own=((0.02, 0.07), (0.01, 0.06)), shared=((0.01, 0.05), (0.005, 0.02))) -> Track:
    """What a tracker says: each pose with an error of its own covariance, and all with errors of one origin in the world."""
    n = len(poses)
    alike = draw_covariance(rng, rng.uniform(*shared[0]), rng.uniform(*shared[1]))
    mean = draw_covariance(rng, rng.uniform(*own[0]), rng.uniform(*own[1]))
    sizes = rng.uniform(0.6, 1.5, n)
    covariance = sizes[:, None, None] ** 2 * mean
    errors = sizes[:, None] * (rng.standard_normal((n, 6)) @ np.linalg.cholesky(mean).T)
    errors += np.linalg.cholesky(alike) @ rng.standard_normal(6)
    return Track(PERIOD_NS * np.arange(n, dtype=np.int64), rigid.moved(poses, errors), covariance, np.tile(alike, (n, 1, 1)))


def slipping(tool: Tool, rotations, rng, size) -> tuple[np.ndarray, np.ndarray]:
    """Tips and dimples of a tip that slips, all at once or evenly, by a size in mm."""
    n = len(rotations)
    at_once = (np.arange(n) >= rng.integers(n // 8, 7 * n // 8)).astype(float)
    growth = at_once if rng.random() < 0.5 else np.linspace(0, 1, n)
    return tool.tip, DIMPLE + growth[:, None] * _direction(rng, size)


def loosened(tool: Tool, rotations, rng, size) -> tuple[np.ndarray, np.ndarray]:
    """The same of a target that moves on the tool."""
    tips, dimples = slipping(tool, rotations, rng, size)
    return tips + dimples - DIMPLE, DIMPLE


def bending(tool: Tool, rotations, rng, size) -> tuple[np.ndarray, np.ndarray]:
    """The same of a shaft that bends: by its weight, by a load to one side, or by a hand that pushes as it tilts.

    size : mm, of the tip by the whole load across the shaft; pushed the other way, it bends to the other side.
    """
    shaft = rotations @ tool.axis
    aside = np.cross(UP, _direction(rng, 1.0))
    leaning = shaft + (shaft @ UP)[:, None] * UP
    load = (np.tile(-UP, (len(shaft), 1)), np.tile(aside / np.linalg.norm(aside), (len(shaft), 1)), leaning)[rng.integers(3)]
    across = load - (load * shaft).sum(axis=1)[:, None] * shaft
    return tool.tip + np.einsum("nji,nj->ni", rotations, rng.choice([-1, 1]) * size * across), DIMPLE


def _direction(rng, length) -> np.ndarray:
    vector = rng.standard_normal(3)
    return length / np.linalg.norm(vector) * vector
