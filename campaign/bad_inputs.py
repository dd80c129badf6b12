"""Bad inputs of every verb, by a grammar of faults: each must be refused in one line, quickly, with nothing written."""

import contextlib
import csv
import random
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.progress import track

from campaign import commands, field_faults, sources
from campaign.byte_faults import Fault, faults_of_any_file
from campaign.commands import Outcome, Run
from campaign.kind_faults import faults_of_kind
from campaign.sources import COMMANDS, Command

LONGEST_S, MOST_MB = 10.0, 2000.0
GIVE_UP_S = 60.0


@dataclass(frozen=True)
class Case:
    """A command with one fault."""

    command: Command
    fault: str
    overrides: tuple[str, ...] = ()
    damage: Callable[[Path], None] | None = None  # done in the folder in which the command is run

    @property
    def line(self) -> tuple[str, ...]:
        """The command line."""
        given = {override.partition("=")[0] for override in self.overrides}
        return (*(field for field in self.command.line if field.partition("=")[0] not in given), *self.overrides)


@dataclass(frozen=True)
class Result:
    """A case and what came of it."""

    case: Case
    outcome: Outcome

    @property
    def fault(self) -> str:
        """What is wrong with it; nothing if it is as it must be."""
        if self.outcome.seconds > GIVE_UP_S:
            return "hangs"
        if not self.outcome.refused:
            lines = len(self.outcome.said.splitlines())
            if self.outcome.status == 0:
                return "accepted"
            if self.outcome.status != 2:
                return "traceback" if "Traceback" in self.outcome.said else f"status {self.outcome.status}"
            return f"{lines} lines" if lines != 1 else f"changed {', '.join(self.outcome.changed[:3])}"
        if self.outcome.seconds > LONGEST_S:
            return "slow"
        return "memory" if self.outcome.peak_mb > MOST_MB else ""


def cases(place: Path, commands: Sequence[Command] = COMMANDS) -> list[Case]:
    """All cases of the grammar."""
    with contextlib.chdir(place):  # whose files of patterns are read for their fields
        of_fields = [list(_of_fields(command)) for command in commands]
    return [case for command, some in zip(commands, of_fields, strict=True) for case in (*some, *_of_files(command, place))]


def _of_fields(command: Command) -> Iterator[Case]:
    named = [field.partition("=") for field in command.fields]
    firsts = ((name, value.strip("[]").split(",")[0].split("/")[0]) for name, _, value in named)  # of a list, too
    inputs = [name for name, first in firsts if first in command.folders]
    for override in field_faults.overrides(command.verb, command.line[1:], inputs):
        yield Case(command, override, (override,))


def _of_files(command: Command, place: Path) -> Iterator[Case]:
    for name in (*command.reads, *command.reads_in_part):
        for fault in _faults(place / name) if name in command.reads else faults_of_any_file(place / name):
            yield Case(command, f"{name}: {fault.name}", damage=partial(_damage, name, fault.name))


def _faults(path: Path) -> Iterator[Fault]:
    yield from faults_of_any_file(path)
    yield from faults_of_kind(path)


def _damage(name: str, fault: str, folder: Path) -> None:
    """Make the fault anew: all together would not fit into memory."""
    next(one for one in _faults(folder / name) if one.name == fault).apply(folder / name)


def chosen(found: Sequence[Case], count: int, seed: int) -> list[Case]:
    """A number of cases: as many of each verb, as far as it has them, drawn at random."""
    by_verb: dict[str, list[Case]] = defaultdict(list)
    for case in found:
        by_verb[case.command.verb].append(case)
    rng, taken = random.Random(seed), list[Case]()
    for some in by_verb.values():
        rng.shuffle(some)
    left = sorted(by_verb.values(), key=len)
    for number, some in enumerate(left):
        taken += some[: (count - len(taken)) // (len(left) - number)]
    return taken


def run(found: Sequence[Case], place: Path, workers: int, command: Run = commands.run) -> list[Result]:
    """Run cases, each in a folder of its own."""
    with ThreadPoolExecutor(workers) as pool:
        return list(track(pool.map(partial(run_one, place, command), found), "bad inputs", len(found)))


def run_one(place: Path, command: Run, case: Case) -> Result:
    """Run one case on links to the sources in `place`."""
    with TemporaryDirectory(dir=place.parent, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        sources.lay_out(folder, place, case.command.folders)
        field_faults.lay_out(folder)
        if case.damage is not None:
            case.damage(folder)
        return Result(case, command(case.line, folder, GIVE_UP_S))


def controls(place: Path, workers: int) -> list[Result]:
    """The commands without faults: all must succeed, or refusals would mean nothing."""
    return run([Case(command, "no fault") for command in COMMANDS if not command.minutes], place, workers)


def write(path: Path, results: Sequence[Result]) -> None:
    """Write a row a case."""
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        table = csv.writer(file)
        table.writerow(["verb", "fault", "wrong", "status", "seconds", "peak_mb", "line", "said"])
        for result in results:
            outcome, line = result.outcome, " ".join(each[:200] for each in result.case.line)
            figures = [result.fault, outcome.status, f"{outcome.seconds:.2f}", f"{outcome.peak_mb:.0f}"]
            table.writerow([result.case.command.verb, result.case.fault[:200], *figures, line, outcome.said[-2000:]])


def table(results: Sequence[Result]) -> list[str]:
    """Lines of Markdown: a row a verb with a fault, and one of all."""
    lines = ["| verb | bad inputs | refused | longest, s | most memory, MB | not refused rightly |", "|---|---|---|---|---|---|"]
    by_verb: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        by_verb[result.case.command.verb].append(result)
    lines += [_row(verb, some) for verb, some in by_verb.items() if any(result.fault for result in some)]
    return [*lines, _row(f"all {len(by_verb)}", results)]


def _row(name: str, results: Sequence[Result]) -> str:
    wrong = Counter(result.fault.split(" ")[0] for result in results if result.fault)
    longest, most = max(r.outcome.seconds for r in results), max(r.outcome.peak_mb for r in results)
    counted = ", ".join(f"{kind} {number}" for kind, number in wrong.items())
    return f"| {name} | {len(results)} | {len(results) - wrong.total()} | {longest:.1f} | {most:.0f} | {counted} |"


def clear(place: Path) -> None:
    """Remove what a campaign that was killed has left beside the sources."""
    for left in place.parent.glob("tmp*"):
        shutil.rmtree(left, ignore_errors=True)
