"""Results of commands, compared by their bytes."""

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path

from recon.capture.board_part import read_board
from recon.capture.images import read_images
from recon.capture.manifest import STAMPS, BoardPart, Manifest, PartName, SurfacePart, image_name, read_manifest
from recon.capture.sweep_tables import read_stamps
from recon.errors import InputError

TIMES = re.compile(
    r"(metrics|training|reconstruct)\.json|log\.jsonl|checkpoint\.pt|curves\.png|.*\.html"
)  # files that hold times or paths
HIDDEN = re.compile(r"\..*\.(new|old)(\..*)?$|\..*\.(lock|occupied|part)$")  # temporaries and locks


def alike(rows: Iterable[tuple[str, str]]) -> list[str]:
    """Lines of Markdown, one for all names whose cells are equal."""
    names: dict[str, list[str]] = {}
    for name, cells in rows:
        names.setdefault(cells, []).append(name)
    return [f"| {', '.join(dict.fromkeys(some))} | {cells} |" for cells, some in names.items()]


def digests(folder: Path) -> dict[str, str]:
    """Digest of each file in a folder that holds no times, by its relative path; none of hidden ones."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not TIMES.fullmatch(path.name) and not any(part.startswith(".") for part in Path(name).parts):
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def unread(capture: Path) -> list[str]:
    """Parts of a capture that the ordinary readers refuse, each with their line."""
    try:
        read = read_manifest(capture)
        for part in read.contents:
            _read_part(capture, read, part)
    except InputError as error:
        return [str(error)]
    return []


def _read_part(capture: Path, read: Manifest, part: PartName) -> None:
    """Read all images and tables of a part; InputError at the first that is wrong."""
    devices, content = read.devices_of(part), read.part(part)
    if isinstance(content, SurfacePart):
        for device, paths in content.images.items():
            read_images([capture / path for path in paths], devices[device].size, devices[device].bits)
    elif isinstance(content, BoardPart):
        captured = read_board(capture)
        for number in range(len(captured.poses)):
            captured.pose(number)
    else:
        for device, folder in content.images.items():
            frames, _ = read_stamps(capture / folder / STAMPS)
            paths = [capture / folder / image_name(frame) for frame in frames.tolist()]
            read_images(paths, devices[device].size, devices[device].bits)


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
