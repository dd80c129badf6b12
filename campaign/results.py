"""Results of commands, compared by their bytes."""

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path

TIMES = re.compile(
    r"(metrics|training|reconstruct)\.json|log\.jsonl|checkpoint\.pt|curves\.png|.*\.html"
)  # files that hold times or paths
HIDDEN = re.compile(r"\..*\.(new|old)(\..*)?$|\..*\.(lock|occupied)$")  # temporaries and locks


def digests(folder: Path) -> dict[str, str]:
    """Digest of each file in a folder that holds no times, by its relative path; none of hidden ones."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not TIMES.fullmatch(path.name) and not any(part.startswith(".") for part in Path(name).parts):
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def leftovers(folder: Path) -> list[str]:
    """Temporaries and locks anywhere in a folder."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob(".*") if HIDDEN.match(path.name))


def processes_of(session: int) -> list[int]:
    """Processes of a session that are alive, zombies apart."""
    alive = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, _, _, number = (entry / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[:4]
            except OSError:
                continue
            if int(number) == session and state != "Z":
                alive.append(int(entry.name))
    return alive


def end(processes: Iterable[int]) -> None:
    """End processes that should have ended by themselves."""
    for process in processes:
        os.kill(process, 9)
