"""Commands whose disk is full before they have ended: status 2 with the place's name, the old result as it was, no leftovers.

The disk is a small file system in memory, which only root can mount.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from campaign import commands, results, sources
from campaign.commands import Run
from campaign.sources import COMMANDS, Command

LONGEST_S = 300.0
SHARES = (0.02, 0.5, 0.9)  # of the result's size that is free beside the old one
GROWING = ("dataset", "train", "study", "reconstruct", "record")  # verbs that go on with what is there, file by file or by step
BLOCK = 4096  # bytes
WITHOUT = ("accuracy", "demo")  # which write by the other verbs


@dataclass(frozen=True)
class Full:
    """What came of a command whose disk was full."""

    verb: str
    share: float
    outcome: commands.Outcome
    kept: bool  # whether the old result is as it was
    left: tuple[str, ...]  # leftovers

    @property
    def good(self) -> bool:
        """Whether it named the place, if there was no room after all, and nothing was lost."""
        lines = self.outcome.said.splitlines()
        named = self.outcome.status == 2 and len(lines) == 1 and "disk/" in lines[0]
        return (named or self.outcome.status == 0) and self.kept and not self.left


def can_mount() -> bool:
    """Whether this process may mount a file system."""
    with TemporaryDirectory() as name:
        try:
            with small_disk(Path(name), 1 << 20):
                return True
        except (OSError, subprocess.CalledProcessError):
            return False


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of so many bytes in a folder."""
    options = f"size={max(size // BLOCK, 1) * BLOCK},nr_inodes=100k"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True, capture_output=True)


def writers() -> list[Command]:
    """A command of each verb that writes."""
    firsts = {command.verb: command for command in reversed(COMMANDS) if command.out and command.verb not in WITHOUT}
    return list(reversed(firsts.values()))


def run(place: Path, only: Sequence[str] = (), run_one: Run = commands.run) -> list[Full]:
    """Fill the disk of each command to some shares of what it needs."""
    found = []
    for command in writers():
        if not only or command.verb in only:
            with TemporaryDirectory(dir=place.parent, ignore_cleanup_errors=True) as name:
                found += fill(place, command, Path(name), run_one)
    return found


def fill(place: Path, command: Command, folder: Path, run_one: Run = commands.run) -> list[Full]:
    """Run one command on disks that hold an old result and are too small for another one."""
    sources.lay_out(folder, place, command.folders)
    disk, old = folder / "disk", folder / "old"
    disk.mkdir()
    line = (command.verb, *command.fields, f"out=disk/{command.out}")
    with small_disk(disk, 1 << 32):
        first = run_one(line, folder, LONGEST_S)
        if first.status:
            raise RuntimeError(f"sonotwin {' '.join(line)}: {first.said}")
        shutil.copytree(disk, old)
        size = _used(disk)
    found = []
    for share in SHARES:
        with small_disk(disk, size + int(share * size)):
            shutil.copytree(old, disk, dirs_exist_ok=True)
            outcome = run_one((*line, *anew(command.verb)), folder, LONGEST_S)
            kept = outcome.status == 0 or _kept(results.digests(old), results.digests(disk), command.verb in GROWING)
            found.append(Full(command.verb, share, outcome, kept, tuple(results.leftovers(disk))))
    return found


def _kept(old: dict[str, str], found: dict[str, str], grows: bool) -> bool:
    """Whether an old result is as it was; of one that grows, whether each of its files is there, as it was or as a new whole."""
    return old.keys() <= found.keys() if grows else old.items() <= found.items()


def anew(verb: str) -> tuple[str, ...]:
    """Fields by which a verb that goes on with its own result makes another one."""
    given = {
        "dataset": ("samples=2",),
        "train": ("steps=4",),
        "study": ("seeds=2",),
        "reconstruct": ("spacing_mm=0.4",),
        "record": ("replace=true",),
    }
    return given.get(verb, ())


def _used(disk: Path) -> int:
    """Bytes that are taken on a file system."""
    status = os.statvfs(disk)
    return (status.f_blocks - status.f_bfree) * status.f_frsize


def table(found: Sequence[Full]) -> list[str]:
    """Lines of Markdown: a row for all verbs with the same outcome, its cells by the rooms tried."""
    rooms = ", ".join(f"{100 * share:.0f} %" for share in dict.fromkeys(one.share for one in found))
    lines = [f"| verb | status at {rooms} | old result kept | leftovers |", "|---|---|---|---|"]
    rows = []
    for verb in dict.fromkeys(one.verb for one in found):
        own = [one for one in found if one.verb == verb]
        statuses = ", ".join(str(one.outcome.status) for one in own)
        kept = ", ".join("yes" if one.kept else "**no**" for one in own)
        rows.append((verb, f"{statuses} | {kept} | {sum(len(one.left) for one in own)}"))
    return [*lines, *results.alike(rows)]
