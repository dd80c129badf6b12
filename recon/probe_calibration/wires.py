"""Wires of finite thickness: crossed, one lies above the other, and their echo comes from before their axes.

Of wires that touch, the axes are a diameter apart. Seen along the image's normal, the two lines still meet, but beside the
midpoint between the axes: with the lines' normals m, m' and the wires' distance g, seen in the image, the meeting point d from
the midpoint obeys `m d = m g / 2`, `m' d = -m' g / 2`. For wires of 0.2 mm that is 1 to 2 px, and more where the lines are alike:
ten times the error of the fitted lines. It changes its sign with the probe's tilt, so it can be separated from the crossing's
place, once each line is assigned to its wire.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_FRAMES = 6  # with two lines, to separate the wires
MOST_PLANES = 80  # for candidates
SPREAD = 0.1  # sine of the angle between a wire and the plane in which it was seen; of short arms
ALIKE = 0.97  # cosine of the angle between wires that are one and the same
MIN_SINE = 0.05  # of the angle between the lines, below which their meeting point is unknown


def echo_ahead(radius_mm: float, wire_speed: float, speed: float) -> float:
    """Distance of the echo of a thin wire before its axis, mm of the medium.

    The echoes of its front and back, about alike, are nearer to each other than the pulse is long, so that the middle between
    both is seen; the back one comes later by the way through the wire. For nylon of 0.2 mm in water that is 0.04 mm.

    Parameters
    ----------
    wire_speed, speed : float, m/s
        Of sound in the wire and in the medium.
    """
    return radius_mm * (1 - speed / wire_speed)


def planes(world_from_image: Array, scale: Array, directions: Array) -> Array:
    """Normals : (n, 2, 3), in the world, of the planes through a line in the image and the image's normal: its wire lies in it.

    Parameters
    ----------
    world_from_image : (n, 3, 3)
        Rotations.
    scale : (2,) mm/px
    directions : (n, 2, 2) px
        Along both lines.
    """
    lines = directions * scale
    normals = np.stack([lines[..., 1], -lines[..., 0], np.zeros(lines.shape[:2])], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals @ np.swapaxes(world_from_image, 1, 2)


def directions_of(seen: Array) -> Array | None:
    """Directions : (2, 3) of the two wires in the world, that lie in most of the planes : (n, 2, 3); None if undetermined.

    Every two planes have one direction in common. The one that lies near most planes is the first wire's, and the one that lies
    near most of the others the second's; then each frame's lines are shared out and each wire is fitted to its planes.
    """
    if len(seen) < MIN_FRAMES:
        return None
    few = seen[:: -(-len(seen) // (MOST_PLANES // 2))].reshape(-1, 3)
    first, second = np.triu_indices(len(few), 1)
    candidates = np.cross(few[first], few[second])
    lengths = np.linalg.norm(candidates, axis=1)
    candidates = candidates[lengths > 0.1] / lengths[lengths > 0.1, None]
    if not len(candidates):
        return None
    near = np.exp(-((np.einsum("cj,nkj->cnk", candidates, seen) / SPREAD) ** 2) / 2)
    one = int(near.max(axis=2).sum(axis=1).argmax())
    left = near * (1 - near[one])
    score = np.where(np.abs(candidates @ candidates[one]) < ALIKE, left.max(axis=2).sum(axis=1), 0)
    wires = np.stack([candidates[one], candidates[int(score.argmax())]])
    if score.max() < MIN_FRAMES / 2:
        return None
    for _ in range(5):
        wires = _fitted(wires, seen)
    return wires


def _fitted(wires: Array, seen: Array) -> Array:
    """Fit each wire to the nearer planes of each pair, far ones left out."""
    near = np.exp(-((np.einsum("wj,nkj->nwk", wires, seen) / SPREAD) ** 2) / 2)
    straight = near[:, 0, 0] + near[:, 1, 1] >= near[:, 0, 1] + near[:, 1, 0]
    own = np.where(straight[:, None, None], seen, seen[:, ::-1])
    weights = np.where(straight[:, None], near[:, [0, 1], [0, 1]], near[:, [0, 1], [1, 0]])
    spread = np.einsum("nw,nwi,nwj->wij", weights, own, own)
    return np.linalg.eigh(spread)[1][:, :, 0]


def beside(world_from_image: Array, scale: Array, wires: Array) -> Array:
    """Meeting points : (n, 2) of the lines of two wires, from the midpoint between their axes; px a mm between these.

    The second wire lies ahead of the first, along the cross product of their directions. Zero where the lines are too alike to
    meet in the image.

    Parameters
    ----------
    world_from_image : (n, 3, 3)
        Rotations.
    wires : (2, 3)
        Their directions in the world, unit vectors.
    """
    across = np.cross(*wires)
    apart = (across / np.linalg.norm(across) @ world_from_image)[:, :2]
    lines = (wires @ world_from_image)[..., :2]
    lines = lines / np.maximum(np.linalg.norm(lines, axis=-1, keepdims=True), 1e-9)
    normals = np.stack([-lines[..., 1], lines[..., 0]], axis=-1)
    sine = np.linalg.det(normals)
    meets = np.abs(sine) > MIN_SINE
    half = np.einsum("nwi,ni->nw", normals, apart) / 2 * [-1, 1]
    place = np.linalg.solve(np.where(meets[:, None, None], normals, np.eye(2)), half[..., None])[..., 0]
    return np.where(meets[:, None], place, 0) / scale
