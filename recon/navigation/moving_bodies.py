"""Tracked bodies in the world in which skin and masses were measured: probe and tools, beside a patient who may have moved."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from recon.model import tracks
from recon.model.rig import PATIENT, PROBE
from recon.model.tip import Tip
from recon.model.tracks import Track
from recon.navigation import tool_distances
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.publishing import BodyAt
from recon.navigation.tool_distances import Surface
from recon.tracking.tracker import Tracking

Array = NDArray[np.float64]

AT_FIRST = "told as the patient stood when first seen, for want of a reference"


@dataclass(frozen=True)
class Placed:
    """The probe and the other bodies at a moment."""

    world_from_target: Array | None  # (4, 4) mm; None where it isn't known
    state: str  # how it was found, or why not
    bodies: tuple[BodyAt, ...] = ()
    covariances: Mapping[str, Array] = field(default_factory=dict)  # (6, 6) of each body's pose that is known


@dataclass
class MovingBodies:
    """Places bodies in the world, and measures the tips of tools in it.

    With a patient the world is the one in which the patient stood at the reference; without one it is camera 1's frame.
    """

    tips: Mapping[str, Tip | None]  # of the tools, by name; None of one whose tip isn't calibrated
    masses: Mapping[str, Surface] = field(default_factory=dict)
    plan: Array | None = None  # (2, 3) mm, entry and aim
    reference: Track | None = None  # the patient's pose at which skin and masses were measured; None: its first one
    _at_first: bool = field(default=False, init=False)  # whether the reference is the first pose

    def place(self, found: Mapping[str, Tracking], time_ns: int) -> Placed:
        """Poses of all bodies by what the tracker finds of each; where the patient isn't seen there are none."""
        poses = {name: _pose_of(one, time_ns) for name, one in found.items() if one.found}
        beside = found.get(PATIENT)
        if beside is not None and not beside.found:
            state = f"patient not found: {beside.pose.reason}; no body is placed"
            return Placed(None, state, tuple(self._body(name, one, None) for name, one in found.items() if name != PROBE))
        if beside is not None:
            if self.reference is None:
                self.reference, self._at_first = poses[PATIENT], True
            reference = self.reference
            poses = {name: tracks.relative(pose, poses[PATIENT], reference) for name, pose in poses.items()}
        target = poses.get(PROBE)
        told = f"; {AT_FIRST}" if self._at_first else ""
        return Placed(
            None if target is None else target.poses[0],
            state_of(found[PROBE]) + told,
            tuple(self._body(name, one, poses.get(name)) for name, one in found.items() if name != PROBE),
            {name: _total(pose) for name, pose in poses.items()},
        )

    def measure(self, placed: Placed, scan: PlacedScan | None) -> tuple[BodyAt, ...]:
        """The bodies besides the probe, with figures of the tips that are known, beside the newest B-scan."""
        plane = None if scan is None else (scan.world_from_pixel, scan.image.shape)
        return tuple(self._measured(body, placed.covariances.get(body.name), plane) for body in placed.bodies)

    def _measured(self, body: BodyAt, covariance: Array | None, plane: tuple[Array, tuple[int, ...]] | None) -> BodyAt:
        tip = self.tips.get(body.name)
        if tip is None or covariance is None or body.world_from_body is None:
            return body
        figures = tool_distances.figures(body.world_from_body, covariance, tip, self.masses, self.plan, plane)
        return replace(body, figures=figures)

    def _body(self, name: str, found: Tracking, told: Track | None) -> BodyAt:
        own = found.pose.world_from_target if found.found else None
        state = state_of(found, "")
        if told is None and found.found:
            state = "patient not found"
        return BodyAt(name, state, None if told is None else told.poses[0], own)


def state_of(found: Tracking, name: str = "target") -> str:
    """How a body was found, or why it wasn't."""
    beside = ", beside a second one of its design" if found.others else ""
    state = f"{found.how}{beside}" if found.found else f"not found: {found.pose.reason}"
    return f"{name} {state}".lstrip()


def _pose_of(found: Tracking, time_ns: int) -> Track:
    """The pose of a body that is found, as a track of one moment."""
    pose = found.pose
    return Track(np.array([time_ns], np.int64), pose.world_from_target[None], pose.covariance[None], pose.shared[None])


def _total(pose: Track) -> Array:
    """Covariance : (6, 6) of the whole error of a track of one moment."""
    assert pose.covariance is not None and pose.shared is not None
    return (pose.covariance + pose.shared)[0]
