"""Points of balls, bars and plates as a camera at the origin sees them, with noise that neighbours share."""

import numpy as np

SHARED = 4  # points that share their noise


def ball(centre, radius, rng, sigma=0.0, patches=400, cap=0.5):
    """Points : (n, 3) mm of the cap of a ball that faces the origin, up to a cosine."""
    centre = np.asarray(centre, float)
    directions = rng.standard_normal((40 * patches, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    facing = directions[directions @ -centre > cap * np.linalg.norm(centre)][:patches]
    jitter = 0.02 * rng.standard_normal((len(facing), SHARED, 3))  # patches' points lie beside each other
    seen = (facing[:, None] + jitter).reshape(-1, 3)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    noise = np.repeat(sigma * rng.standard_normal(len(facing)), SHARED)
    return centre + seen * (radius + noise)[:, None]


def plate(centre, size, rng, sigma=0.0, patches=400, sag=0.0):
    """Points of a plate that faces the origin; its middle sags towards it by some mm against its corners."""
    aside = np.repeat(rng.uniform(-0.5, 0.5, (patches, 2)), SHARED, axis=0)
    noise = np.repeat(sigma * rng.standard_normal(patches), SHARED)
    depth = noise + sag * 2 * np.sum(aside**2, axis=1)
    return np.asarray(centre) + np.column_stack([aside * size, depth])


def rod(start, end, radius, rng, count=1500):
    """Points of a rod, on the side of the origin."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = (end - start) / np.linalg.norm(end - start)
    towards = -start - (-start @ along) * along
    towards /= np.linalg.norm(towards)
    angle = rng.uniform(-1.3, 1.3, count)[:, None]
    around = np.cos(angle) * towards + np.sin(angle) * np.cross(along, towards)
    return start + rng.uniform(0, 1, count)[:, None] * (end - start) + radius * around
