"""A demonstration: named steps that work in one folder, one after the other, each adding its figures to those before it."""

import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon import atomic

Metrics = dict[str, float | int]

MARKER = "demo.json"  # by which the folder of a demonstration is known
METRICS = "metrics.json"


@dataclass(frozen=True)
class Step:
    """One step."""

    name: str  # a verb, in one word
    does: str  # what a person reads while it runs
    work: Callable[[Path, Mapping[str, float | int]], Mapping[str, float | int]]  # (folder, figures so far) -> its own figures
    makes: Sequence[str] = ()  # files at the top of the folder


def play(steps: Sequence[Step], folder: Path, settings: Mapping[str, object], announce: Callable[[str], None]) -> Metrics:
    """Run the steps and write `metrics.json`: all their figures, and the seconds that each took.

    The folder is marked before the first step, and what an earlier demonstration left there is taken away as far as it would
    mix with the new: after a run that was killed, the next one starts clean.

    Parameters
    ----------
    settings : mapping
        What the demonstration is made from; written to the folder as its marker.
    announce : callable
        Told each step's number and what it does.

    Raises
    ------
    InputError
        If the folder holds something else, or can't be written to.
    """
    atomic.check_folder(folder, MARKER)
    folder.mkdir(parents=True, exist_ok=True)
    with atomic.new_file(folder / MARKER) as temporary:
        temporary.write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
    _clear(folder, [METRICS, *(name for step in steps for name in step.makes)])
    metrics: Metrics = {}
    beginning = time.perf_counter()
    for number, step in enumerate(steps, 1):
        announce(f"{number}/{len(steps)} {step.does}")
        start = time.perf_counter()
        metrics |= step.work(folder, metrics)
        metrics[f"seconds_{step.name}"] = round(time.perf_counter() - start, 2)
    metrics["seconds_demo"] = round(time.perf_counter() - beginning, 2)
    with atomic.new_file(folder / METRICS) as temporary:
        temporary.write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    return metrics


def _clear(folder: Path, names: Sequence[str]) -> None:
    """Remove results of an earlier run, and the temporary files and folders of one that was killed."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
    for leftover in folder.glob(".*"):
        if leftover.is_dir():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()
