"""A demonstration: named steps that work in one folder, one after the other, each adding its figures to those before it."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from recon.files import atomic, metrics, written_files
from recon.files.metrics import Metrics

MARKER = "demo.json"
DEMO = "demo"  # who writes


@dataclass(frozen=True)
class Step:
    """One step."""

    name: str  # a verb, in one word
    does: str  # what a person reads while it runs
    work: Callable[[Mapping[str, float | int]], Mapping[str, float | int] | None]  # figures so far -> its own
    makes: Sequence[str] = ()  # files at the top of the folder


def play(
    steps: Sequence[Step],
    folder: Path,
    settings: Mapping[str, object],
    announce: Callable[[str], None],
    afresh: Mapping[str, str] = MappingProxyType({}),
) -> Metrics:
    """Run the steps and write `metrics.json`: all their figures, and the seconds that each took.

    The folder is marked before the first step, and what an earlier demonstration wrote there is taken away as far as it would
    mix with the new: after a run that was killed, the next one starts clean. Files of others stay.

    Parameters
    ----------
    settings : mapping
        What the demonstration is made from; written to the folder as its marker.
    announce : callable
        Told each step's number and what it does.
    afresh : mapping
        Folders in it that begin empty: what their writer left there is taken away.

    Raises
    ------
    InputError
        If the folder holds something else, or can't be written to.
    ValueError
        If a step contradicts a figure of an earlier one.
    """
    atomic.check_filled_folder(folder, DEMO)
    for name, writer in afresh.items():
        atomic.check_folder(folder / name, writer)
    files = [metrics.FILE, *(name for step in steps for name in step.makes)]
    for name in files:
        atomic.check_listed(folder, name, DEMO)
    atomic.begin_filled(folder, DEMO)
    with atomic.listed_file(folder, MARKER, DEMO) as temporary:
        temporary.write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
    for name in (MARKER, *files, *afresh):
        atomic.remove_leftovers(folder / name)
    atomic.remove_listed(folder, files, DEMO)
    for name, writer in afresh.items():
        written_files.discard(folder / name, writer)
    found: Metrics = {}
    beginning = time.perf_counter()
    for number, step in enumerate(steps, 1):
        announce(f"{number}/{len(steps)} {step.does}")
        start = time.perf_counter()
        new = dict(step.work(found) or {})
        new[f"seconds_{step.name}"] = round(time.perf_counter() - start, 2)
        for name in new.keys() & found.keys():
            if new[name] != found[name]:
                raise ValueError(f"{step.name}: {name}: expected {found[name]} as before, found {new[name]}")
        found |= new
    found["seconds_demo"] = round(time.perf_counter() - beginning, 2)
    with atomic.listed_file(folder, metrics.FILE, DEMO) as temporary:
        metrics.write(temporary, found)
    return found
