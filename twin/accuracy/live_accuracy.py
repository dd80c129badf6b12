"""The live rig's rows: clocks of devices, patterns on a display, guided board poses, light on the skin."""

from twin.accuracy import live_basler_accuracy, live_poses_accuracy, live_projector_accuracy, live_skin_accuracy
from twin.accuracy.table_rows import Measurement, Setup

PARTS = (live_basler_accuracy, live_projector_accuracy, live_poses_accuracy, live_skin_accuracy)


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group."""
    return [measurement for part in PARTS for measurement in part.measurements(setup)]
