"""Memory that is free for a training: the machine's, or less where a container or a batch system bounds it."""

import math
import os
from pathlib import Path
from typing import NamedTuple

GROUPS = Path("/sys/fs/cgroup")


class Files(NamedTuple):
    """Names of a control group's files."""

    bound: str
    used: str
    idle: str  # of the row in memory.stat with pages of files that were not read lately, bytes


FILES = {  # by the kinds of a group: of the second version of control groups, and of the first
    "": Files("memory.max", "memory.current", "inactive_file"),
    "memory": Files("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}


def free_bytes() -> int:
    """Memory that can be taken without swapping."""
    return int(min(_of_machine(), _of_group()))


def _of_machine() -> int:
    try:
        rows = dict(line.split(":") for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
        return int(rows["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):  # no Linux, or an old one
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def _of_group() -> float:
    """Least memory that is left in this process's control group and those above it; infinite without a bound."""
    left = [float("inf")]
    for kinds, group in (line.split(":", 2)[1:] for line in _groups() if line.count(":") >= 2):
        if kinds in FILES:
            root = GROUPS / kinds
            folder = root / group.lstrip("/")
            left += [_left(above, FILES[kinds]) for above in (folder, *folder.parents) if above.is_relative_to(root)]
    return min(left)


def _left(folder: Path, files: Files) -> float:
    """The bound of a group less what its processes use; pages of files that were not read lately are given back on demand."""
    used, idle = _number(folder / files.used), 0
    try:
        rows = (line.split() for line in (folder / "memory.stat").read_text(encoding="ascii").splitlines())
        idle = next((int(count) for name, count in rows if name == files.idle), 0)
    except (OSError, ValueError):
        pass
    busy = max(used - idle, 0) if math.isfinite(used) else 0
    return max(_number(folder / files.bound) - busy, 0)


def _groups() -> list[str]:
    """Control groups of this process, as NUMBER:KINDS:GROUP."""
    try:
        return Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def _number(path: Path) -> float:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):  # the root has no such file, and "max" is no bound
        return float("inf")
