"""Settings of steps that track the target, and the networks and the tracker that they make."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from recon.capture import target_files
from recon.geometry.camera import Camera
from recon.model.calibration import DRIFT_PX, Uncertainty
from recon.model.part import Part
from recon.model.rig import PROBE, Rig, Target
from recon.registry import Choice
from recon.session.settings import BoardField, TargetField
from recon.tracking import networks
from recon.tracking.bodies import BodyTracker
from recon.tracking.networks import OnnxNetworks
from recon.tracking.tracker import Tracker


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


def target_of(fields: MeasuredTargetFields) -> Target:
    """The target as it was measured, else its design; InputError as of `recon.capture.target_files.read`."""
    design = fields.rig.target
    return design if fields.target is None else target_files.read(fields.target, design)


def make_body_tracker(
    fields: MeasuredTargetFields, cameras: tuple[Camera, Camera], known: Uncertainty | None, bits: int | None
) -> BodyTracker:
    """The tracker of all bodies of a rig, of which the probe's target may have been measured; raises as `make_tracker`."""
    loaded = networks.load(fields.networks or networks.WEIGHTS, fields.threads, fields.rig.target.kind, by_geometry=True)
    targets = fields.rig.targets | {PROBE: target_of(fields)}
    settings = bits, known, fields.drift_px, fields.board_scale
    return BodyTracker({name: Tracker(cameras, target, loaded, *settings) for name, target in targets.items()})


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
