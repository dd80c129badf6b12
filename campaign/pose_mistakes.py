"""Plausible mistakes in tables of poses and of time stamps: units, frames, order, frozen, late."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from campaign.capture_mistakes import UNITS, Change, Mistake, Rng, write
from recon.capture import sweep_tables
from recon.geometry import rigid
from recon.model.tracks import Track

Array = NDArray[np.float64]


def track(path: str, how: Callable[[Track, Rng], tuple[NDArray, Array]]) -> Change:
    """A changed table of poses: times (n,) ns and poses (n, 4, 4), as plain text."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        table = folder / path
        header, *lines = table.read_text(encoding="utf-8").splitlines()
        right = sweep_tables.read_track(table)
        times, poses = how(right, rng)
        rows = []
        for line, time, pose in zip(lines, times.tolist(), poses, strict=True):
            words = line.split(",")
            words[0] = str(time)
            placed = bool(np.isfinite(pose).all())
            words[1] = str(int(placed))
            words[2:14] = [f"{x:.9g}" if placed else "" for x in pose[:3].ravel()]
            rows.append(",".join(words))
        write(table, "\n".join([header, *rows]) + "\n")
        return ()

    return change


def poses_by(how: Callable[[Array, Rng], Array]) -> Callable[[Track, Rng], tuple[NDArray, Array]]:
    """Poses that were found, changed together; times as they are."""

    def change(right: Track, rng: Rng) -> tuple[NDArray, Array]:
        poses = right.poses.copy()
        poses[right.found] = how(poses[right.found], rng)
        return right.times, poses

    return change


def _scaled(factor: float, poses: Array, rng: Rng) -> Array:
    poses = poses.copy()
    poses[:, :3, 3] *= factor
    return poses


def _inverted(poses: Array, rng: Rng) -> Array:
    return np.array([rigid.invert(pose) for pose in poses])


def _transposed(poses: Array, rng: Rng) -> Array:
    poses = poses.copy()
    poses[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return poses


def _frozen(poses: Array, rng: Rng) -> Array:
    poses = poses.copy()
    length = min(10, len(poses) // 3)
    first = int(rng.integers(1, len(poses) - length))
    poses[first : first + length] = poses[first]
    return poses


def _lost_as_identity(poses: Array, rng: Rng) -> Array:
    poses = poses.copy()
    poses[rng.choice(len(poses), max(2, len(poses) // 7), replace=False)] = np.eye(4)
    return poses


def _one_far(poses: Array, rng: Rng) -> Array:
    poses = poses.copy()
    poses[int(rng.integers(1, len(poses) - 1)), 0, 3] += 5000
    return poses


def _shuffled(poses: Array, rng: Rng) -> Array:
    return poses[rng.permutation(len(poses))]


def _reversed(poses: Array, rng: Rng) -> Array:
    return poses[::-1]


def _degrees_as_radians(poses: Array, rng: Rng) -> Array:
    poses = poses.copy()
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec(degrees=True)
    poses[:, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
    return poses


def _axes_exchanged(poses: Array, rng: Rng) -> Array:
    poses = poses.copy()
    poses[:, [0, 1], 3] = poses[:, [1, 0], 3]
    return poses


POSES: Mapping[str, tuple[str, str, Callable[[Array, Rng], Array]]] = {
    **{
        f"poses' translations in {name}": (
            "units",
            r"unit|metres|inch|in cm|in mm",
            partial(_scaled, factor),
        )
        for name, factor in UNITS.items()
    },
    "poses the other way round": ("frames", r"invers|other way|frames? of|target_from|world_from", _inverted),
    "rotations transposed": ("frames", r"transpos|invers|rotation", _transposed),
    "degrees read as radians": ("units", r"degree|radian|rotation|turn|speed|jump", _degrees_as_radians),
    "x and y of the poses exchanged": ("frames", r"axes|exchang|swap", _axes_exchanged),
    "ten poses frozen": ("frozen", r"frozen|repeat|same|rest|identical", _frozen),
    "lost poses written as identity": ("frozen", r"identity|jump|lost|far|speed", _lost_as_identity),
    "one pose 5 m off": ("frozen", r"jump|far|speed|mm off", _one_far),
    "poses shuffled": ("order", r"order|jump|speed|shuffl", _shuffled),
    "poses in reversed order": ("order", r"order|revers", _reversed),
}


def of_poses(table: str) -> list[Mistake]:
    """Mistakes in a table of poses."""
    found = [Mistake(kind, what, cause, track(table, poses_by(how))) for what, (kind, cause, how) in POSES.items()]
    late = lambda right, rng: (right.times, np.roll(right.poses, int(rng.integers(1, 4)), axis=0))  # noqa: E731
    return [*found, Mistake("late", "poses late by some rows", r"late|lag|order|jump", track(table, late))]


def stamps(path: str, how: Callable[[NDArray, Rng], NDArray]) -> Change:
    """Changed time stamps of images, of a table whose last column they are."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        table = folder / path
        header, *lines = table.read_text(encoding="utf-8").splitlines()
        words = [line.split(",") for line in lines]
        column = next(k for k, name in enumerate(header.split(",")) if "time" in name)
        times = how(np.array([int(row[column]) for row in words]), rng)
        for row, time in zip(words, times.tolist(), strict=True):
            row[column] = str(time)
        write(table, "\n".join([header, *(",".join(row) for row in words)]) + "\n")
        return ()

    return change


def of_stamps(table: str) -> list[Mistake]:
    """Mistakes in a table of time stamps."""
    unit, clock = r"unit|clock|stamp|time|ns", r"stamp|repeat|equal|increas|clock|time"
    return [
        Mistake("units", "time stamps in us", unit, stamps(table, lambda times, rng: times // 1000)),
        Mistake("units", "time stamps in ms", unit, stamps(table, lambda times, rng: times // 1_000_000)),
        Mistake("frozen", "all time stamps equal", clock, stamps(table, lambda times, rng: np.full_like(times, times[0]))),
        Mistake("frozen", "time stamps repeated", clock, stamps(table, lambda times, rng: times[np.arange(len(times)) // 2 * 2])),
        Mistake("order", "time stamps reversed", clock, stamps(table, lambda times, rng: times[::-1])),
        Mistake("device", "another clock", r"clock|time|lag", stamps(table, lambda times, rng: times + 10**12)),
        Mistake("late", "stamps late by 50 ms", r"late|lag|clock", stamps(table, lambda times, rng: times + 50_000_000)),
    ]
