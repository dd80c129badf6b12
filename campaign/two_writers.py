"""Two processes that write one folder at once, each in a process namespace of its own, as on two machines with one disk."""

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile

from campaign import commands, results, sources
from campaign.commands import Run
from campaign.kills import KILLED, Killed

LONGEST_S = 600.0
APART = ("unshare", "--pid", "--fork", "--kill-child", "--mount-proc")  # a namespace of processes; only root may


@dataclass(frozen=True)
class Pair:
    """What came of two processes."""

    verb: str
    statuses: tuple[int, int]
    said: tuple[str, str]
    right: bool  # whether the result is that of one of them alone
    left: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether both were right, or one was refused by a line, and the result is whole."""
        fine = sorted(self.statuses) in ([0, 0], [0, 2]) and "Traceback" not in "".join(self.said)
        return fine and self.right and not self.left


def can_part() -> bool:
    """Whether this process may make process namespaces."""
    return subprocess.run([*APART, "true"], capture_output=True, check=False).returncode == 0


def run(place: Path, rounds: int, only: Sequence[str] = ()) -> list[Pair]:
    """Start each command twice, with the same settings and with others."""
    return [
        pair
        for killed in KILLED
        if not only or killed.verb in only
        for first in {killed.first or killed.then, killed.then}
        for pair in both(place, killed, first, rounds)
    ]


def both(place: Path, killed: Killed, first: tuple[str, ...], rounds: int, command: Run = commands.run) -> list[Pair]:
    """Run two command lines at once, each first alone, by `command`."""
    with TemporaryDirectory(dir=place.parent, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        sources.lay_out(folder, place, killed.folders)
        alone = []
        for line in dict.fromkeys((first, killed.then)):
            outcome = command((*line[:-1], f"out=alone{len(alone)}"), folder, LONGEST_S)
            if outcome.status:
                raise RuntimeError(f"sonotwin {' '.join(line)}: {outcome.said}")
            alone.append(results.digests(folder / f"alone{len(alone)}"))
        pairs = []
        for number in range(rounds):
            lines = [(*line[:-1], f"out=new{number}") for line in (first, killed.then)]
            statuses, said = _at_once(lines, folder)
            right = results.digests(folder / f"new{number}") in alone
            pairs.append(Pair(killed.verb, statuses, said, right, tuple(results.leftovers(folder))))
        return pairs


def _at_once(lines: Sequence[tuple[str, ...]], folder: Path) -> tuple[tuple[int, int], tuple[str, str]]:
    options = {"cwd": folder, "env": commands.environment(), "stdout": subprocess.DEVNULL}
    with TemporaryFile() as one, TemporaryFile() as other:
        running = [
            subprocess.Popen([*APART, *commands.SONOTWIN, *line], stderr=said, **options)
            for line, said in zip(lines, (one, other), strict=True)
        ]
        statuses = running[0].wait(LONGEST_S), running[1].wait(LONGEST_S)
        one.seek(0)
        other.seek(0)
        return statuses, (one.read().decode(), other.read().decode())


def table(pairs: Sequence[Pair]) -> list[str]:
    """Lines of Markdown: a row for all pairs with the same outcome."""
    lines = ["| verb | statuses | result of one alone | leftovers | refusal |", "|---|---|---|---|---|"]
    rows = []
    for pair in pairs:
        refusal = next((said.strip().splitlines()[-1] for said in pair.said if said.strip()), "")
        statuses = " and ".join(map(str, pair.statuses))
        rows.append((pair.verb, f"{statuses} | {'yes' if pair.right else '**no**'} | {len(pair.left)} | `{refusal[-90:]}`"))
    return [*lines, *results.alike(rows)]
