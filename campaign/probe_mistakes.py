"""Wrong set-ups of a probe's calibration: what moves that should rest, a lag that nobody knows, another phantom than defined."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from campaign.capture_mistakes import Change, Mistake, Rng, given, write
from campaign.pose_mistakes import stamps, track
from recon.geometry import rigid
from recon.model.tracks import Track
from recon.model.wire_phantom import FCAL_2

Array = NDArray[np.float64]

MOVED = r"slip|gives|pushed|moved against|moved by"
PHANTOM = r"another phantom|defin|strung|hole|front and back|sides of all N-wires parallel"
LATE = r"with lag_s=|are late|are early|lag_s=free"
FCAL_1 = (  # mm, front and back of each wire: PLUS's phantom fCal 1, of two N-wires
    (((20, 0, 5), (20, 40, 5)), ((25, 0, 5), (45, 40, 5)), ((50, 0, 5), (50, 40, 5))),
    (((20, 0, 0), (20, 40, 0)), ((45, 0, 0), (25, 40, 0)), ((50, 0, 0), (50, 40, 0))),
)


def _after(how: Callable[[Array, Array], Array], least: float, most: float) -> Callable[[Track, Rng], tuple[NDArray, Array]]:
    """Poses changed from a moment between a third and two thirds on, by a step of some mm, and as many degrees over two."""

    def change(right: Track, rng: Rng) -> tuple[NDArray, Array]:
        poses, first = right.poses.copy(), int(len(right.poses) * rng.uniform(1 / 3, 2 / 3))
        length, (turn, shift) = rng.uniform(least, most), rng.standard_normal((2, 3))
        turn, shift = (each / np.linalg.norm(each) for each in (turn, shift))
        step = rigid.transform(Rotation.from_rotvec(np.radians(length / 2) * turn).as_matrix(), length * shift)
        poses[first:] = how(poses[first:], step)
        return right.times, poses

    return change


def _tank(poses: Array, step: Array) -> Array:
    """As the world sees a phantom that was pushed: by the inverse of its movement, about the probe."""
    about = rigid.transform(np.eye(3), poses[:, :3, 3].mean(axis=0))
    return about @ step @ rigid.invert(about) @ poses


def of_motion(table: str) -> list[Mistake]:
    """The phantom is pushed half-way, or the bracket slips, by little and by much; an exchange of target and reference."""
    return [
        *(
            Mistake("moved", f"{what} by {least:g} to {most:g} mm", MOVED, track(table, _after(how, least, most)))
            for what, how in (("phantom moved half-way", _tank), ("probe slipped half-way", lambda poses, step: poses @ step))
            for least, most in ((2, 5), (5, 20))
        ),
        Mistake("frames", "poses in another body's frame, which moves", r"another body", track(table, _of_a_hand)),
    ]


def _of_a_hand(right: Track, rng: Rng) -> tuple[NDArray, Array]:
    """As of a reference that is held in a hand: up and down by 10 mm, to and fro by 5 degrees."""
    seconds = (right.times - right.times[0]) * 1e-9
    phase, poses = 2 * np.pi * (0.31 * seconds + rng.random()), right.poses.copy()
    turns = Rotation.from_rotvec(np.radians(5) * np.sin(1.3 * phase)[:, None] * rng.standard_normal(3)).as_matrix()
    poses[:, :3] = turns @ poses[:, :3]
    poses[:, :3, 3] += 10 * np.sin(phase)[:, None] * [0, 0, 1]
    return right.times, poses


def of_lag(stamped: str) -> list[Mistake]:
    """Time stamps that are late or early by more than a hand's motion forgives, or run at another pace."""

    def late(low: float, high: float) -> Change:
        return stamps(stamped, lambda times, rng: times + np.int64(1e9 * rng.uniform(low, high)))

    def paced(times: NDArray, rng: Rng) -> NDArray:
        return times[0] + ((times - times[0]) * (1 + 0.02 * rng.uniform(0.5, 1))).astype(np.int64)

    return [
        Mistake("late", "B-scans late by 0.05 to 0.1 s", LATE, late(0.05, 0.1)),
        Mistake("late", "B-scans late by 0.15 to 0.3 s", LATE, late(0.15, 0.3)),
        Mistake("late", "B-scans early by 0.15 to 0.3 s", LATE, late(-0.3, -0.15)),
        Mistake("late", "a clock that runs 1 to 2 % fast", LATE + "|clock|mov|slip", stamps(stamped, paced)),
    ]


def of_clip(width: int, height: int) -> list[Mistake]:
    """Clips and scales of another probe."""

    def clip(folder: Path, rng: Rng) -> tuple[str, ...]:
        u, v = int(rng.integers(width // 3, width // 2)), int(rng.integers(height // 3, height // 2))
        return (f"clip=[{u},{v},{width - u},{height - v}]",)

    def scale(folder: Path, rng: Rng) -> tuple[str, ...]:
        factor = float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.2, 0.7)))
        return (f"rig.probe.scale_mm_per_px=[{0.1229 * factor:.4f},{0.1225 * factor:.4f}]", "temperature_c=22")

    return [
        Mistake("device", "another probe's clip", r"clip|found|view|frames|dots", clip),
        Mistake("device", "another probe's scale", r"scale|depth setting|speed", scale),
    ]


def _defined(change: Callable[[Array, Rng], Array]) -> Change:
    """Another definition of the N-wires."""
    from tests.recon.probe_calibration import test_plus_phantom

    def made(folder: Path, rng: Rng) -> tuple[str, ...]:
        write(folder / "other.xml", test_plus_phantom.written(change(np.array(FCAL_2, float), rng)))
        return ("wires=other.xml",)

    return made


def _swapped(ends: Array, rng: Rng) -> Array:
    """Two of the wires exchanged at one end."""
    ends, (a, b) = ends.copy(), rng.choice(3 * len(ends), 2, replace=False)
    flat = ends.reshape(-1, 2, 3)
    flat[[a, b], 1] = flat[[b, a], 1]
    return ends


def _restrung(ends: Array, rng: Rng) -> Array:
    """The diagonal of one N-wire the other way."""
    ends, row = ends.copy(), int(rng.integers(len(ends)))
    ends[row, 1, :, 0] = ends[row, 1, ::-1, 0]
    return ends


def _hole(ends: Array, rng: Rng) -> Array:
    """One wire in the next hole, at both ends."""
    ends, row = ends.copy(), int(rng.integers(len(ends)))
    ends[row, int(rng.choice([0, 2])), :, 0] += rng.choice([-5, 5])
    return ends


def of_rows() -> list[Mistake]:
    """Definitions that are of other wires."""
    return [
        Mistake("units", "wires in metres", PHANTOM + "|unit", _defined(lambda ends, rng: ends / 1000)),
        Mistake("units", "wires in inches", PHANTOM + "|unit", _defined(lambda ends, rng: ends / 25.4)),
        Mistake("field", "wires printed 3 to 8 % larger", PHANTOM, _defined(lambda ends, rng: ends * rng.uniform(1.03, 1.08))),
        Mistake("field", "ends of two wires exchanged", PHANTOM, _defined(_swapped)),
        Mistake("field", "one diagonal the other way", PHANTOM, _defined(_restrung)),
        Mistake("field", "a wire in the next hole", PHANTOM, _defined(_hole)),
        Mistake("mirrored", "the definition mirrored", PHANTOM + "|mirror", _defined(lambda ends, rng: ends * [-1, 1, 1])),
        Mistake("device", "another phantom, fCal 1", PHANTOM + "|dots", _defined(lambda ends, rng: np.array(FCAL_1, float))),
        Mistake("device", "crossed wires", r"phantom=|crossing|N-wires|candidates", given("phantom=crossed_wires", "wires=null")),
    ]
