"""Speed of the live rig: cameras, OpenIGTLink, navigation, guided board poses, light on the skin."""

from benchmarks import live_basler_speed, live_igtl_speed, live_navigate_speed, live_poses_speed, live_skin_speed
from twin.experiments.table_rows import Measurement

PARTS = (live_basler_speed, live_igtl_speed, live_navigate_speed, live_poses_speed, live_skin_speed)


def measurements() -> list[Measurement]:
    """The rows of the group."""
    return [measurement for part in PARTS for measurement in part.measurements()]
