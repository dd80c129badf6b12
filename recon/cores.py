"""The cores that this process may use. Imports nothing that an incomplete installation may lack."""

import os


def usable() -> int:
    """Their number; of all of the machine where the system doesn't say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
