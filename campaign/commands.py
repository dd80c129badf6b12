"""Run a command of sonotwin as a user would, and measure: status, lines on stderr, time, memory, and what changed on the disk."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

SONOTWIN = (sys.executable, "-m", "sonotwin")
LOOK_S = 0.02  # between two looks whether a command has ended

Snapshot = dict[str, tuple[int, int, int]]  # path -> kind and mode, size, time of the last change in ns


@dataclass(frozen=True)
class Outcome:
    """What came of a command."""

    status: int  # as of a shell: 128 more than a signal's number
    said: str  # on stderr
    seconds: float
    peak_mb: float
    changed: tuple[str, ...] = ()  # files and folders that were made, removed or written to

    @property
    def refused(self) -> bool:
        """Whether it ended as bad input must: status 2, one line by us, nothing written."""
        lines = self.said.splitlines()
        return self.status == 2 and len(lines) == 1 and lines[0].startswith("sonotwin: ") and not self.changed


Run = Callable[[Sequence[str], Path, float], Outcome]  # of arguments in a folder, for some seconds at most
Kill = Callable[[Sequence[str], Path, int, float], tuple[int, bool]]  # of arguments in a folder, by a signal after some seconds


def run(arguments: Sequence[str], folder: Path, longest_s: float) -> Outcome:
    """Run `sonotwin ARGUMENTS` in a folder; one that takes too long is killed, with all its processes."""
    before, start = snapshot(folder), time.perf_counter()
    with TemporaryFile() as said:
        process, peak_mb = begin(arguments, folder, said), 0.0
        while process.poll() is None:
            peak_mb = max(peak_mb, memory_mb(process.pid))
            if time.perf_counter() - start > longest_s:
                os.killpg(process.pid, signal.SIGKILL)
            time.sleep(LOOK_S)
        seconds = time.perf_counter() - start
        said.seek(0)
        text = said.read().decode(errors="backslashreplace")
    status = process.returncode if process.returncode >= 0 else 128 - process.returncode
    return Outcome(status, text, seconds, peak_mb, changes(before, snapshot(folder)))


def kill(arguments: Sequence[str], folder: Path, number: int, after_s: float) -> tuple[int, bool]:
    """Begin a command and send it a signal after some seconds; its session, and whether it had ended by itself before."""
    process = begin(arguments, folder, subprocess.DEVNULL)
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
        process.wait()
        return process.pid, False
    return process.pid, True


def memory_mb(process: int, field: str = "VmHWM") -> float:
    """Largest memory of a process so far, or with VmRSS that of now; 0 of one that has ended, or where the system doesn't say."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith(field)), 0.0)


def environment() -> dict[str, str]:
    """Variables of a command that is run in any folder."""
    return os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[1])}


def begin(arguments: Sequence[str], folder: Path, said: IO[bytes] | int) -> subprocess.Popen:
    """Begin a command, in a process group of its own."""
    return subprocess.Popen(
        [*SONOTWIN, *arguments],
        cwd=folder,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=said,
        start_new_session=True,
    )


def snapshot(folder: Path) -> Snapshot:
    """All that is in a folder, links not followed. Times of folders don't count: a temporary sibling that is gone is no loss."""
    found = {}
    for place, folders, files in os.walk(folder):
        for name in folders + files:
            path = os.path.join(place, name)
            status = os.lstat(path)
            is_folder = name in folders and not os.path.islink(path)
            found[os.path.relpath(path, folder)] = (status.st_mode, 0, 0) if is_folder else (
                status.st_mode, status.st_size, status.st_mtime_ns
            )  # fmt: skip
    return found


def changes(before: Snapshot, after: Snapshot) -> tuple[str, ...]:
    """Paths that differ between two snapshots."""
    return tuple(sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name)))
