"""Settings of steps that track the target, and the networks and the tracker that they make."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from recon.capture import target_files
from recon.errors import InputError, did_you_mean
from recon.geometry.camera import Camera
from recon.model import circle_layout
from recon.model.calibration import DRIFT_PX, Uncertainty
from recon.model.part import Part
from recon.model.rig import PROBE, Rig, Target
from recon.registry import Choice
from recon.session.settings import BoardField, BodyTargetFields, TargetField
from recon.tracking import networks
from recon.tracking.bodies import BodyTracker
from recon.tracking.networks import OnnxNetworks
from recon.tracking.tracker import Tracker

OTHER_MM, OTHER_TOLERANCES = 1.0, 10.0  # off its design, by which a measured target is another body's, or tolerances of a circle


class NetworkFields(Part):
    """Fields of a step that looks for the target by networks."""

    networks: Path | None = None
    """folder of detector.onnx and segmenter.onnx; null for those that come with sonotwin"""
    naming: Literal["networks", "geometry"] = "networks"
    """by which a circle gets its name: networks that were trained for this kind of target; or its place among the others alone,
    with any networks: slower, and of covered circles fewer are found"""

    def load_networks(self, kind: str, threads: int) -> OnnxNetworks:
        """The networks for a kind of target; InputError as of `recon.tracking.networks.load`."""
        way = f"train it with a data set of {kind}, or give naming=geometry: circles' names by their places alone"
        return networks.load(self.networks or networks.WEIGHTS, threads, kind, self.naming == "geometry", way)


class TrackingFields(BoardField, NetworkFields):
    """Fields of a step that tracks the target by cameras some time after their calibration."""

    drift_px: Annotated[float, Field(ge=0, le=10)] = DRIFT_PX
    """px, standard deviation of principal points since the calibration: warmth, a turned mount; focal lengths by 4e-4 of it,
    relative"""


class TrackerFields(TrackingFields):
    """Fields of a step that tracks the target by a tracker of its own."""

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the target's design: distances and diameters of its circles, and their tolerance"""
    calibration: Path | None = None
    """file of the devices' calibration, used instead of the capture's own"""
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """cores for the networks, 0 for all; another number may change last digits"""


class MeasuredTargetFields(TargetField, TrackerFields):
    """Fields of a step that tracks the target as it was measured, by a tracker of its own."""


class BodyFields(BodyTargetFields, MeasuredTargetFields):
    """Fields of a step that tracks all bodies of the rig."""


def target_of(fields: MeasuredTargetFields) -> Target:
    """The target as it was measured, else its design; InputError as of `recon.capture.target_files.read`."""
    design = fields.rig.target
    return design if fields.target is None else target_files.read(fields.target, design)


def targets_of(fields: BodyFields) -> dict[str, Target]:
    """Targets of all bodies by name, as they were measured, else their designs.

    Raises
    ------
    InputError
        As of `recon.capture.target_files.read`, or if a measured one is of no body of the rig.
    """
    bodies = fields.rig.bodies
    for name in fields.measured:
        if name not in bodies:
            expected = f"one of rig.bodies, {', '.join(bodies)}" if bodies else "none, as rig.bodies names none"
            raise InputError(f"measured.{name}: expected {expected}, found {name}{did_you_mean(name, list(bodies))}")
    read = {name: target_files.read(path, bodies[name]) for name, path in fields.measured.items()}
    for name, measured in read.items():
        off = circle_layout.lengths(measured) - circle_layout.lengths(bodies[name])
        if np.abs(off).max() > (most := max(OTHER_MM, OTHER_TOLERANCES * bodies[name].tolerance_mm)):
            worst = int(np.abs(off).argmax())
            found = f"{measured.LENGTHS[worst]} off by {off[worst]:+.2f} mm: another body's?"
            raise InputError(f"measured.{name}: {fields.measured[name]}: expected its design to {most:g} mm, found {found}")
    return {PROBE: target_of(fields), **bodies, **read}


def make_rig_tracker(
    fields: BodyFields,
    targets: Mapping[str, Target],
    cameras: tuple[Camera, Camera],
    known: Uncertainty | None,
    bits: int | None,
    search_s: float = 0.0,
) -> Tracker | BodyTracker:
    """The tracker of the probe alone, or of all bodies where the rig has any; targets as of `targets_of`."""
    if fields.rig.bodies:
        return make_body_tracker(fields, targets, cameras, known, bits, search_s)
    return make_tracker(fields, targets[PROBE], cameras, known, bits)


def make_body_tracker(
    fields: BodyFields,
    targets: Mapping[str, Target],
    cameras: tuple[Camera, Camera],
    known: Uncertainty | None,
    bits: int | None,
    search_s: float = 0.0,
) -> BodyTracker:
    """The tracker of all bodies of a rig; see `make_tracker`, and `BodyTracker` for `search_s`."""
    loaded = networks.load(fields.networks or networks.WEIGHTS, fields.threads, fields.rig.target.kind, by_geometry=True)
    settings = bits, known, fields.drift_px, fields.board_scale
    trackers = {name: Tracker(cameras, target, loaded, *settings) for name, target in targets.items()}
    return BodyTracker(trackers, search_s)


def make_tracker(
    fields: TrackerFields, target: Target, cameras: tuple[Camera, Camera], known: Uncertainty | None, bits: int | None
) -> Tracker:
    """The tracker of a target, by cameras some time after their calibration.

    Parameters
    ----------
    known : of the cameras' calibration; None where it has none
    bits : of frames deeper than 8 bits; None of others

    Raises
    ------
    InputError
        If a network is missing, isn't one, or is of another kind of target.
    """
    loaded = fields.load_networks(target.kind, fields.threads)
    return Tracker(cameras, target, loaded, bits, known, fields.drift_px, fields.board_scale)
