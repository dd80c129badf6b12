"""The live rig's rows: devices, recordings, guided board poses, light on the skin, and the check of the rig."""

from twin.experiments import (
    check_rates,
    live_basler_accuracy,
    live_board_accuracy,
    live_poses_accuracy,
    live_projector_accuracy,
    live_record_accuracy,
    live_skin_accuracy,
)
from twin.experiments.table_rows import Measurement, Setup

PARTS = (
    live_basler_accuracy,
    live_projector_accuracy,
    live_record_accuracy,
    live_board_accuracy,
    live_poses_accuracy,
    live_skin_accuracy,
    check_rates,
)


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group."""
    return [measurement for part in PARTS for measurement in part.measurements(setup)]
