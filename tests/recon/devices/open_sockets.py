"""What this process has open."""

import os
from contextlib import suppress


def sockets() -> int:
    """Number of sockets that this process has open."""
    count = 0
    for number in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):  # of the listing itself
            count += os.readlink(f"/proc/self/fd/{number}").startswith("socket:")
    return count
