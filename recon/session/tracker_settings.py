"""Settings of steps that track the target by a tracker of their own, and the tracker that they make."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from recon.capture import target_files
from recon.geometry.camera import Camera
from recon.model.calibration import Uncertainty
from recon.model.rig import Rig, Target
from recon.registry import Choice
from recon.session.settings import TargetField, TrackingFields
from recon.tracking import networks
from recon.tracking.tracker import Tracker


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


def target_of(fields: MeasuredTargetFields) -> Target:
    """The target as it was measured, else its design; InputError as of `recon.capture.target_files.read`."""
    design = fields.rig.target
    return design if fields.target is None else target_files.read(fields.target, design)


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
    folder, by_geometry = fields.networks or networks.WEIGHTS, fields.naming == "geometry"
    loaded = networks.load(folder, fields.threads, target.kind, by_geometry)
    return Tracker(cameras, target, loaded, bits, known, fields.drift_px, fields.board_scale)
