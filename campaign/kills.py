"""Commands killed at random moments, again and again: what stands in their place is an old result or a new one, never a half."""

import random
import shutil
import signal
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from campaign import commands, results, sources
from campaign.commands import Kill, Run

LONGEST_S = 300.0
IN_A_ROW = 5  # kills before the command is let run to its end
ORPHANS_S = 3.0  # within which all processes of a killed command must have ended
SIGNALS = (signal.SIGKILL, signal.SIGTERM)


@dataclass(frozen=True)
class Killed:
    """A command that replaces the result of an earlier one, or goes on with it."""

    verb: str
    first: tuple[str, ...]  # the earlier one; empty if there was none
    then: tuple[str, ...]
    folders: tuple[str, ...] = ()  # sources
    grows: bool = (
        False  # file by file: each of the result's is old, new or not there yet; else the folder is old or new as a whole
    )
    recorded: bool = False  # a capture whose files grow: what it names is whole; which frames it has depends on the moment


FILM = ("film", "frames=4", "path.turn_deg=20", "white_dn=120")
SWEEP = ("sweep", *sources.STROKE)
TRAIN = ("train", "network=detector", "data=data", "batch=2", "crop_px=64", "threads=1", "checkpoint_minutes=0.01")
RECORD = ("record", "part=surface", "scene=sphere", "cameras=[cam1]", "tracing.samples=2", "preview.serve=false")
KILLED = (
    Killed("surface", ("surface", "capture=ball/capture", "limits.max_sigma=2", "out=new"),
           ("surface", "capture=ball/capture", "out=new"), ("ball",)),
    Killed("film", (*FILM, "seed=1", "out=new"), (*FILM, "seed=2", "out=new")),
    Killed("sweep", (*SWEEP, "seed=1", "out=new"), (*SWEEP, "seed=2", "out=new")),
    Killed("dataset", ("dataset", "samples=2", "shard=2", "out=new"),
           ("dataset", "samples=8", "shard=2", "engine.workers=2", "out=new"), grows=True),
    Killed("train", (), (*TRAIN, "steps=40", "out=new"), ("data",), grows=True),
    Killed("reconstruct", ("reconstruct", "capture=scan/capture", "spacing_mm=1.0", "out=new"),
           ("reconstruct", "capture=scan/capture", "spacing_mm=0.5", "out=new"), ("scan",), grows=True),
    Killed("record", (*RECORD, "seed=1", "out=new"), (*RECORD, "replace=true", "seed=2", "out=new"), recorded=True),
)  # fmt: skip


@dataclass
class Tally:
    """What came of the kills of one command by one signal."""

    verb: str
    signal: str
    kills: int = 0
    completed: int = 0  # runs that had ended before the kill
    torn: list[str] = field(default_factory=list)  # results that were neither old nor new
    orphans: int = 0
    other_bytes: list[str] = field(default_factory=list)  # results in the end that an unbroken run doesn't give
    left: list[str] = field(default_factory=list)  # leftovers after the next success
    failed: list[str] = field(default_factory=list)  # what the next run said if it failed

    @property
    def good(self) -> bool:
        """Whether nothing was lost."""
        return not (self.torn or self.orphans or self.other_bytes or self.left or self.failed)


def run(
    place: Path,
    moments: int,
    seed: int,
    workers: int,
    only: Sequence[str] = (),
    command: Run = commands.run,
    kill: Kill = commands.kill,
) -> list[Tally]:
    """Kill each command at a number of moments by each signal."""
    jobs = [(killed, number) for killed in KILLED if not only or killed.verb in only for number in SIGNALS]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda job: _killed(place, job[0], job[1], moments, seed, command, kill), jobs))


def _killed(place: Path, killed: Killed, number: signal.Signals, moments: int, seed: int, command: Run, kill: Kill) -> Tally:
    """Kill one command by one signal."""
    rng, tally = random.Random(f"{seed} {killed.verb} {number}"), Tally(killed.verb, number.name)
    with TemporaryDirectory(dir=place.parent, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        sources.lay_out(folder, place, killed.folders)
        kept, old = folder / "kept", dict[str, str]()
        kept.mkdir()
        if killed.first:
            old, _ = _unbroken(folder, killed.first, command)
            shutil.copytree(folder / "new", kept, dirs_exist_ok=True)
        new, seconds = _unbroken(folder, killed.then, command)
        while tally.kills < moments:
            shutil.rmtree(folder / "new")
            shutil.copytree(kept, folder / "new")
            for _ in range(min(IN_A_ROW, moments - tally.kills)):
                session, ended = kill(killed.then, folder, number, rng.uniform(0.0, 1.05 * seconds))
                tally.kills, tally.completed = tally.kills + 1, tally.completed + ended
                tally.orphans += _orphans(session)
                tally.torn += _faults(folder / "new", killed, old, new)
            outcome = command(killed.then, folder, LONGEST_S)
            if outcome.status:
                tally.failed.append(outcome.said.strip())
                continue
            found = results.digests(folder / "new")
            if killed.recorded:
                tally.torn += results.unread(folder / "new")
            else:
                tally.other_bytes += sorted(path for path in found.keys() | new.keys() if found.get(path) != new.get(path))
            tally.left += results.leftovers(folder)
    return tally


def _unbroken(folder: Path, line: tuple[str, ...], command: Run) -> tuple[dict[str, str], float]:
    """Digests and duration of a run that isn't killed."""
    outcome = command(line, folder, LONGEST_S)
    if outcome.status:
        raise RuntimeError(f"sonotwin {' '.join(line)}: {outcome.said}")
    return results.digests(folder / "new"), outcome.seconds


def _orphans(session: int) -> int:
    """Number of processes of a killed command that go on; they are ended."""
    until = time.perf_counter() + ORPHANS_S
    while (alive := results.processes_of(session)) and time.perf_counter() < until:
        time.sleep(0.05)
    results.end(alive)
    return len(alive)


def _faults(folder: Path, killed: Killed, old: dict[str, str], new: dict[str, str]) -> list[str]:
    """What isn't whole of a result whose command was killed."""
    return results.unread(folder) if killed.recorded else _torn(results.digests(folder), old, new, killed.grows)


def _torn(found: dict[str, str], old: dict[str, str], new: dict[str, str], grows: bool) -> list[str]:
    """Files that are neither of the old result nor of the new, or gone; a mixture, of a folder that is exchanged as a whole."""
    if not grows:
        return [] if found in (old, new) else ["a mixture"]
    lost = [path for path in old.keys() & new.keys() if path not in found]
    return lost + [path for path, digest in found.items() if digest not in (old.get(path), new.get(path))]


def table(tallies: Sequence[Tally]) -> list[str]:
    """Lines of Markdown: a row a command and signal."""
    faults = ["neither old nor new", "orphans", "other bytes in the end", "leftovers", "failed to go on"]
    lines = [f"| verb | signal | kills | ended before | {' | '.join(faults)} |", "|---" * 9 + "|"]
    rows = []
    for one in tallies:
        counts = [len(one.torn), one.orphans, len(one.other_bytes), len(one.left), len(one.failed)]
        rows.append((one.verb, f"{one.signal} | {one.kills} | {one.completed} | {' | '.join(map(str, counts))}"))
    return [*lines, *results.alike(rows)]
