"""Score results of the open benchmark, which anybody's programs wrote as plain files, against the sealed truth.

Reads RESULTS/NUMBER-TASK/ for each session: calibration.yaml (OpenCV's, or ours), poses.csv, surface.ply, volume.mha and
masses/*.stl; docs/benchmark.md says what is in them. Reads the truth/ folder of `sonotwin render-benchmark`. What isn't there
counts as missing, never as zero; a damaged file is refused. Writes into the folder `out` scores.csv (a row a session and
figure), summary.csv and scores.html: mean over the sessions with its 95 % interval (bootstrap over sessions), median, and how
many are missing. Takes some seconds a session.

    sonotwin score-benchmark results=outputs/mine truth=outputs/practice/truth out=outputs/scores
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from recon.errors import InputError, did_you_mean
from recon.files import atomic
from recon.files.metrics import Metrics, shown
from recon.model.rig import Part
from recon.reports import page
from twin.evaluation import benchmark_results
from twin.session import read_json

DRAWS = 2000  # of the bootstrap
FEWEST = 5  # sessions of an interval
HEAD = ("task", "figure", "sessions", "missing", "mean", "low95", "high95", "median")


class Config(Part):
    """Fields of `sonotwin score-benchmark`."""

    results: Path
    """folder with a folder for each session, of the session's name"""
    truth: Path
    """truth/ of the round"""
    round: Path | None = None
    """benchmark.json of the round, as it was published; null takes the one beside truth/, without which nothing is checked"""
    unchecked: bool = False
    """score by another truth than the one that the round committed to, too"""
    out: Path
    """folder; gets scores.csv, summary.csv and scores.html"""
    title: Annotated[str, Field(max_length=200)] = "results"
    """name of the method, for the page"""


def run(config: Config) -> None:
    """Score and write; InputError if a file is damaged, or a folder of results is no session's."""
    atomic.check_folder(config.out, "score-benchmark", inputs=(config.results, config.truth))
    names = sessions(config.truth)
    committed = None if config.unchecked else commitments(config.truth, config.round)
    if committed is None:
        print("truth       not checked against a round's benchmark.json")
    else:
        check_truth(config.truth, names, committed)
    if not config.results.is_dir():
        raise InputError(f"{config.results}: expected a folder with results of sessions, found none")
    for one in sorted(path for path in config.results.iterdir() if not path.name.startswith(".")):
        if one.name not in names:
            raise InputError(f"{one}: expected the name of a session, found none of them{did_you_mean(one.name, names)}")
        if not one.is_dir():
            raise InputError(f"{one}: expected a folder with a session's results, found a file")
    found = {name: benchmark_results.score(_task(name), config.results / name, config.truth / name) for name in names}
    rows = summary(found)
    with atomic.new_folder(config.out, "score-benchmark") as folder:
        each = [(name, figure, repr(float(value))) for name, of in found.items() for figure, value in of.items()]
        _table(folder / "scores.csv", ("session", "figure", "value"), each)
        _table(folder / "summary.csv", HEAD, rows)
        (folder / "scores.html").write_text(_page(config.title, rows, found), encoding="utf-8")
    for row in rows:
        print(f"{row[0]:<11} {row[1]:<22} {row[4]} [{row[5]}, {row[6]}], {row[3]} of {row[2]} missing")
    print(f"wrote       {config.out}/{{scores.csv,summary.csv,scores.html}}")


def sessions(truth: Path) -> list[str]:
    """Names of the sessions with a truth; InputError if there are none."""
    names = sorted(path.name for path in truth.iterdir() if _task(path.name)) if truth.is_dir() else []
    if not names:
        raise InputError(f"{truth}: expected the truth/ folder of a round, with folders such as 000000-optics, found none")
    return names


def commitments(truth: Path, given: Path | None) -> dict[str, str] | None:
    """SHA-256 of each session's truth by the round's benchmark.json; None if there is none beside the truth.

    Raises
    ------
    InputError
        If the file isn't one of a round.
    """
    path = given or truth.parent / benchmark_results.ROUND
    if given is None and not path.is_file():
        return None
    there = read_json(path)
    found = there.get("truth_sha256")
    if there.get("format") != benchmark_results.FORMAT or not isinstance(found, dict):
        raise InputError(f"{path}: expected a round's {benchmark_results.ROUND} with truth_sha256, found something else")
    return found


def check_truth(truth: Path, names: Sequence[str], committed: dict[str, str]) -> None:
    """Check that the truth is the one that a round committed to; InputError, by the session's name, if it isn't."""
    way = "unchecked=true scores by it all the same"
    for name in names:
        expected, found = committed.get(name), benchmark_results.digest(truth / name)
        if expected is None:
            raise InputError(f"{truth / name}: expected a session of the round, found none in {benchmark_results.ROUND}; {way}")
        if found != expected:
            why = "edited, damaged, or of another round?"
            raise InputError(f"{truth / name}: expected the truth of SHA-256 {expected}, found {found}: {why} {way}")


def summary(found: dict[str, Metrics]) -> list[tuple[str, ...]]:
    """Rows of HEAD for each task and figure: over the sessions that have the figure."""
    rows: list[tuple[str, ...]] = []
    for task in benchmark_results.TASKS:
        of_task = [figures for name, figures in found.items() if _task(name) == task]
        known = list(dict.fromkeys(figure for figures in of_task for figure in figures))
        if of_task and not known:
            rows.append((task, "nothing", str(len(of_task)), str(len(of_task)), *4 * ("unknown",)))
        for figure in known:
            values = np.array([figures.get(figure, np.nan) for figures in of_task])
            there = values[np.isfinite(values)]
            numbers = [np.nan] * 4
            if len(there):
                draws = np.random.default_rng(0).choice(there, (DRAWS, len(there))).mean(axis=1)
                interval = np.quantile(draws, (0.025, 0.975)) if len(there) >= FEWEST else (np.nan, np.nan)
                numbers = [there.mean(), *interval, np.median(there)]
            texts = (shown(float(number), ".4g") for number in numbers)
            rows.append((task, figure, str(len(values)), str(len(values) - len(there)), *texts))
    return rows


def _task(name: str) -> str:
    """The task in a session's name; nothing if it is none."""
    number, _, task = name.partition("-")
    return task if number.isdecimal() and task in benchmark_results.TASKS else ""


def _table(path: Path, head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


def _page(title: str, rows: list[tuple[str, ...]], found: dict[str, Metrics]) -> str:
    here = sum(bool(figures) for figures in found.values())
    opening = page.Opening(
        "open benchmark", title, f"Results of {here} of {len(found)} sessions.", [("sessions", str(len(found)), "")]
    )
    caption = (
        f"Mean over sessions, its 95 % interval by a bootstrap over sessions, of {FEWEST} or more, median. "
        "Missing results count in no figure."
    )
    absent = [name for name, figures in found.items() if not figures]
    sections = [page.Section("Scores", [page.table(HEAD, rows, caption)])]
    if absent:
        sections.append(page.Section("Missing", [page.paragraph(", ".join(absent))]))
    return page.render(opening, sections, "sonotwin score-benchmark")
