"""Memory that is free for a training: the machine's, or less where a container or a batch system bounds it."""

import os
from pathlib import Path

GROUPS = Path("/sys/fs/cgroup")


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
    """Least bound of this process's control group and those above it; infinite without one."""
    bounds = [float("inf")]
    for kinds, group in (line.split(":", 2)[1:] for line in _groups() if line.count(":") >= 2):
        root, file = (GROUPS, "memory.max") if not kinds else (GROUPS / "memory", "memory.limit_in_bytes")
        if kinds in ("", "memory"):  # the second and the first version of control groups
            folder = root / group.lstrip("/")
            bounds += [_number(above / file) for above in (folder, *folder.parents) if above.is_relative_to(root)]
    return min(bounds)


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
