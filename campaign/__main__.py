"""`python -m campaign [PART ...] [count=N]`: attack every command, write what came of it to outputs/campaign/ and docs/trust.md.

Parts: bad_inputs, mistakes, set_ups, foreign, fuzzing, kills, full_disk, two_writers, soak; all of them take some hours. A part
that was done is kept in outputs/campaign/PART.md until it is asked for by name.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from campaign import bad_inputs, foreign, full_disk, fuzzing, kills, mistakes, soak, sources, two_writers
from campaign.mistaken_tasks import TASKS, WIRED, Task
from recon.files import atomic
from twin.experiments import document_tables

ROOT = Path(__file__).resolve().parents[1]
OUT, DOCUMENT = ROOT / "outputs" / "campaign", ROOT / "docs" / "trust.md"
WORKERS = 2


@dataclass(frozen=True)
class Part:
    """A part of the campaign."""

    does: str
    run: Callable[[Path, int], tuple[list[str], int]]  # (sources, count) -> lines of a table, and how many of its rows are faults
    count: int  # usual
    possible: Callable[[], bool] = lambda: True  # for this process


def _bad_inputs(place: Path, count: int) -> tuple[list[str], int]:
    for control in bad_inputs.controls(place, WORKERS):
        if control.outcome.status:
            raise RuntimeError(f"sonotwin {' '.join(control.case.line)}: {control.outcome.said}")
    found = bad_inputs.run(bad_inputs.chosen(bad_inputs.cases(place), count, seed=0), place, WORKERS)
    bad_inputs.write(OUT / "bad_inputs.csv", found)
    return bad_inputs.table(found), sum(bool(one.fault) for one in found)


def _foreign(place: Path, count: int) -> tuple[list[str], int]:
    begun = OUT / "foreign_begun.jsonl"  # goes on from there after an end in between
    found = foreign.run(place, WORKERS, kept=begun)
    begun.unlink()
    for one in found:
        if one.lost or one.status == -1:
            print(f"{one.writer}: {one.content}: {one.said.strip()}: {', '.join(one.lost)}")
    return foreign.table(found), sum(bool(one.lost) or one.status == -1 for one in found)


def _mistakes(place: Path, count: int, name: str = "mistakes", tasks: Sequence[Task] = TASKS) -> tuple[list[str], int]:
    begun = OUT / f"{name}_begun.csv"  # goes on from there after an end in between
    found = mistakes.run(place, count, WORKERS, begun, tasks)
    begun.replace(OUT / f"{name}.csv")
    wrong = sum(one.outcome == "silently wrong" for one in found)
    named, harmful = mistakes.named(found, tasks)
    lines = [*mistakes.table(found), "", f"Of {harmful} that aren't harmless {named} are named, {100 * named / harmful:.0f} %."]
    return lines, wrong * (wrong > mistakes.SILENT * count) + sum(one.outcome == "traceback" for one in found)


def _fuzzing(place: Path, count: int) -> tuple[list[str], int]:
    found = fuzzing.run(place, float(count))
    return fuzzing.table(found), sum(bool(one.faults) for one in found)


def _kills(place: Path, count: int) -> tuple[list[str], int]:
    found = kills.run(place, count, 0, WORKERS)
    return kills.table(found), sum(not one.good for one in found)


def _full_disk(place: Path, count: int) -> tuple[list[str], int]:
    found = full_disk.run(place)
    return full_disk.table(found), sum(not one.good for one in found)


def _two_writers(place: Path, count: int) -> tuple[list[str], int]:
    found = two_writers.run(place, count)
    return two_writers.table(found), sum(not one.good for one in found)


def _soak(place: Path, count: int) -> tuple[list[str], int]:
    found = [soak.run(place, verb, count or usual) for verb, usual in soak.COUNTS.items()]
    return soak.table(found), sum(one.growth_mb > 50 or one.slowing > 0.05 for one in found)


PARTS = {
    "bad_inputs": Part("bad inputs of every verb", _bad_inputs, 1600),
    "foreign": Part("files of others where each command writes", _foreign, 0),
    "mistakes": Part("plausible mistakes over the verbs", _mistakes, 500),
    "set_ups": Part("wrong set-ups of a probe's calibration", partial(_mistakes, name="set_ups", tasks=WIRED), 200),
    "fuzzing": Part("seconds of fuzzing of each reader", _fuzzing, 600),
    "kills": Part("moments of kills of each command, by each signal", _kills, 50),
    "full_disk": Part("full disks", _full_disk, 0, full_disk.can_mount),
    "two_writers": Part("pairs of writers of each command", _two_writers, 3, two_writers.can_part),
    "soak": Part("long runs, 0 for the usual numbers", _soak, 0),
}


def main(arguments: Sequence[str]) -> int:
    """Run parts, those that have no table yet if none is named; returns 1 if one has found a fault."""
    counts = [int(each.removeprefix("count=")) for each in arguments if each.startswith("count=")]
    named = [each for each in arguments if not each.startswith("count=")]
    unknown = set(named) - PARTS.keys()
    if unknown:
        print(f"campaign: {unknown.pop()}: expected one of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    place = OUT / "sources"
    sources.make(place)
    bad_inputs.clear(place)
    faults = 0
    for name in named or [name for name in PARTS if not (OUT / f"{name}.md").exists()]:
        part = PARTS[name]
        if not part.possible():
            print(f"{name}: left out, as only root may do this")
            continue
        lines, wrong = part.run(place, counts[0] if counts else part.count)
        faults += wrong
        with atomic.new_file(OUT / f"{name}.md") as path:
            path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        document_tables.refresh(DOCUMENT, name, "\n".join(lines))
        print(f"{name}: {wrong} faults", *lines, "", sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
