"""Plausible mistakes, drawn over the verbs: refused, warned of, harmless, or wrong without a word.

A result is wrong if its figures of any name lie more than three of its own predicted standard deviations from those without the
mistake, in RMS or more than 2 % of them. What is claimed counts; what is lost (a pixel, a frame) doesn't, unless it is all.
"""

import contextlib
import csv
import io
import multiprocessing
import os
import re
import traceback
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from campaign import mistake_figures, sources
from campaign.capture_mistakes import Mistake
from campaign.mistake_figures import Figures
from campaign.mistaken_tasks import TASKS, Task

WRONG_SIGMA = 3.0
SILENT = 0.01  # share of the mistakes that may be wrong without a word
SEED = 44
COLUMNS = ("number", "verb", "kind", "what", "outcome", "sigma", "said")
NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
WORDS = re.compile(r"^(warning|dropped|alarm|sonotwin: )|, left out|are left out|is it |are they |\?$", re.I)

Kind = Literal["refused by its cause", "refused", "warned", "harmless", "silently wrong", "traceback"]
KINDS: tuple[Kind, ...] = ("refused by its cause", "refused", "warned", "harmless", "silently wrong", "traceback")


@dataclass(frozen=True)
class Run:
    """What commands said and found in a folder."""

    status: int  # 2 where one was refused; -1 where one ended in a traceback
    said: str
    figures: Figures


@dataclass(frozen=True)
class Outcome:
    """What came of a mistake."""

    number: int
    verb: str
    kind: str  # of the mistake
    what: str
    outcome: Kind
    sigma: float  # of the figures from the right ones; NaN where there are none
    said: str  # the line that matters

    @property
    def row(self) -> tuple[object, ...]:
        """Its row of a table of COLUMNS."""
        return self.number, self.verb, self.kind, self.what, self.outcome, f"{self.sigma:.3g}", self.said


def drawn(number: int, tasks: Sequence[Task] = TASKS) -> tuple[Task, Mistake]:
    """The task and mistake of a number: verbs in turn, and each one's mistakes in turn from a random order."""
    task = tasks[number % len(tasks)]
    turn, which = divmod(number // len(tasks), len(task.mistakes))
    order = np.random.default_rng([SEED, len(task.name), turn]).permutation(len(task.mistakes))
    return task, task.mistakes[order[which]]


def run(place: Path, count: int, workers: int, kept: Path | None = None, tasks: Sequence[Task] = TASKS) -> list[Outcome]:
    """Make mistakes number 0 to count - 1 with links to the sources in `place`; those in a table `kept` aren't made again.

    Tasks whose sources aren't there are left out.
    """
    names = [task.name for task in tasks if all((place / name).exists() for name in task.folders)]
    found = {} if kept is None or not kept.exists() else {one.number: one for one in _read(kept)}
    left = [number for number in range(count) if number not in found]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        for outcome in pool.map(partial(make, place, names), left):
            found[outcome.number] = outcome
            if kept is not None:
                write(kept, list(found.values()))
            print(f"{outcome.number + 1} of {count}: {outcome.verb}, {outcome.what}: {outcome.outcome}", flush=True)
    return [found[number] for number in range(count)]


_RIGHT: dict[tuple[Path, str], Run] = {}  # of a process


def make(place: Path, names: Sequence[str], number: int) -> Outcome:
    """Make one mistake of the tasks of some names."""
    task, mistake = drawn(number, [task for task in TASKS if task.name in names])
    if (place, task.name) not in _RIGHT:
        right = _commands(place, task, None, np.random.default_rng(0))
        if right.status:
            raise RuntimeError(f"{task.name}: without a mistake: {right.said[-500:]}")
        _RIGHT[place, task.name] = right
    right = _RIGHT[place, task.name]
    made = _commands(place, task, mistake, np.random.default_rng([SEED, number]))
    kind, sigma, said = judged(made, right, mistake)
    return Outcome(number, task.name, mistake.kind, mistake.what, kind, sigma, said)


def judged(made: Run, right: Run, mistake: Mistake) -> tuple[Kind, float, str]:
    """The outcome of a mistake: its kind, the figures' distance from the right ones, and the line that names it."""
    lines = [line.strip() for line in made.said.splitlines() if line.strip()]
    if made.status == -1:
        return "traceback", np.nan, lines[-1]
    if made.status == 2:
        said = next((line for line in reversed(lines) if line.startswith("sonotwin: ")), lines[-1])
        return "refused by its cause" if re.search(mistake.cause, said, re.I) else "refused", np.nan, said
    usual = {NUMBER.sub("#", line) for line in right.said.splitlines()}
    new = [line for line in lines if WORDS.search(line) and NUMBER.sub("#", line) not in usual]
    sigma = mistake_figures.distance(made.figures, right.figures)
    if new or made.status:
        return "warned", sigma, new[0] if new else f"status {made.status}"
    return ("silently wrong" if sigma > WRONG_SIGMA else "harmless"), sigma, ""


def _commands(place: Path, task: Task, mistake: Mistake | None, rng: np.random.Generator) -> Run:
    """Run the commands of a task on links to the sources, after a mistake."""
    from sonotwin import cli

    with TemporaryDirectory(dir=place.parent, ignore_cleanup_errors=True) as name:
        folder, said = Path(name), io.StringIO()
        sources.lay_out(folder, place, task.folders)
        fields = () if mistake is None else mistake.change(folder, rng)
        before = Path.cwd()
        os.chdir(folder)
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                for line in task.lines(fields):
                    if status := cli.main(line):
                        return Run(status, said.getvalue(), {} if status == 2 else task.figures(folder))
            return Run(0, said.getvalue(), task.figures(folder))
        except Exception:  # noqa: BLE001 a traceback is an outcome
            return Run(-1, said.getvalue() + traceback.format_exc(), {})
        finally:
            os.chdir(before)


def write(path: Path, found: Sequence[Outcome]) -> None:
    """Write a row a mistake, whole or not at all."""
    part = path.with_suffix(".part")
    with part.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        table.writerows(one.row for one in found)
    part.replace(path)


def _read(path: Path) -> list[Outcome]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    return [
        Outcome(int(number), verb, kind, what, next(one for one in KINDS if one == outcome), float(sigma), said)
        for number, verb, kind, what, outcome, sigma, said in rows
    ]


def named(found: Sequence[Outcome], tasks: Sequence[Task] = TASKS) -> tuple[int, int]:
    """Number of the mistakes that a refusal or a warning names by their cause, and of all that aren't harmless."""
    causes = {(task.name, mistake.what): mistake.cause for task in tasks for mistake in task.mistakes}
    harmful = [one for one in found if one.outcome != "harmless"]
    told = [one for one in harmful if one.said and re.search(causes.get((one.verb, one.what), "$."), one.said, re.I)]
    return len(told), len(harmful)


def table(found: Sequence[Outcome]) -> list[str]:
    """Lines of Markdown: a row a verb, then those that were wrong without a word, by the number of times."""
    by_verb: Mapping[str, list[Outcome]] = defaultdict(list)
    for one in found:
        by_verb[one.verb].append(one)
    heads = "refused by its cause | refused for another | warned of | harmless | wrong without a word | traceback"
    lines = [f"| verb | mistakes | {heads} |", "|" + "---|" * (len(KINDS) + 2)]
    for verb, some in [*sorted(by_verb.items()), ("all", list(found))]:
        counts = [sum(one.outcome == kind for one in some) for kind in KINDS]
        lines.append(f"| {verb} | {len(some)} | {' | '.join(map(str, counts))} |")
    silent = Counter(one.what for one in found if one.outcome == "silently wrong")
    words = ", ".join(f"{what} {count}" for what, count in sorted(silent.items()))
    return [*lines, "", f"Wrong without a word: {words or 'none'}."]
