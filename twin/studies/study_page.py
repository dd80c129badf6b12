"""A study's page: its figures over its factors, and a table."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from recon.files import atomic
from recon.files.metrics import shown
from recon.reports import figures, page
from recon.reports.page import Opening, Section
from twin.experiments.experiment_runs import Experiment
from twin.studies import study_plots, study_runs
from twin.studies.study_plots import Name, short, words
from twin.studies.study_runs import ERROR, SEED, Done

PAGE, PICTURES = "report.html", "figures"
NO_NAMES: Mapping[str, Name] = MappingProxyType({})
MOST_ROWS = 100  # points of a design in the page's table
FOOTER = "Range: from the least to the greatest over seeds and the other factors. This file is complete: it fetches nothing."


def write(
    folder: Path,
    title: str,
    done: Sequence[Done],
    sections: Sequence[Section],
    commands: Sequence[str],
    points: Sequence[str] | None = None,
) -> None:
    """Write `report.html`: sections, what gave no figures, and the commands that make the same again.

    Parameters
    ----------
    points : labels of the trials' points, for people; if not given, the values that vary
    """
    table, fields = study_runs.rows(done), list(done[0].trial.point)
    points = labels(done) if points is None else points
    failed = [row for row in table if row[ERROR] is not None]
    named_alike = (f"{named(one, point)}: {one.found}" for one, point in zip(done, points, strict=True) if one.failed)
    reasons = dict.fromkeys(named_alike)
    pandas = f"python -c \"import pandas; print(pandas.read_parquet('{folder / study_runs.TABLE}'))\""
    parts = [*sections, *([Section("Points without figures", [page.notices(reasons)])] if failed else [])]
    parts.append(Section("Again, and the table in pandas", [page.commands([*commands, pandas])]))
    counted = [("trials", page.count(len(table)), ""), ("points", page.count(len(_distinct_points(table, fields))), "")]
    result = f"{len(table) - len(failed)} of {len(table)} trials gave figures."
    with atomic.listed_file(folder, PAGE, study_runs.BY) as path:
        path.write_text(page.render(Opening("study", title, result, counted), parts, FOOTER), encoding="utf-8")


def plots(folder: Path, done: Sequence[Done], of: Experiment, names: Mapping[str, Name] = NO_NAMES) -> list[Section]:
    """Sections of all figures over all factors, whose plots are kept as PNG files too.

    Parameters
    ----------
    names : of figures for people, and what the paper reports of them; other figures have those of their columns
    """
    table, fields = study_runs.rows(done), list(done[0].trial.point)
    return [
        Section(
            title(_name(names, figure).title),
            [page.grid((_drawn(folder, table, of, figure, field, names) for field in fields), "two")],
        )
        for figure in of.limits
        if fields
    ]


def points(done: Sequence[Done], of: Experiment, names: Mapping[str, Name] = NO_NAMES) -> Section:
    """A table of all points: sums of counts, and medians of other figures."""
    table, fields = study_runs.rows(done), list(done[0].trial.point)
    titles = [_name(names, figure).title for figure in of.counts]
    for figure, limit in of.limits.items():
        table, shown_as = study_plots.comparable(table, figure, limit, _name(names, figure))
        titles.append(shown_as)
    head = [*map(words, fields), "trials", *titles]
    caption = f"Medians over seeds; in brackets: {of.limit}."
    if of.counts:
        caption = f"Sums over seeds of {words(of.counts[0])} to {words(of.counts[-1])}. Medians over seeds of all else."
    return Section("All points", [page.table(head, _points(table, fields, of), caption)])


def title(text: str) -> str:
    """A text with a capital letter."""
    return text[:1].upper() + text[1:]


def _name(names: Mapping[str, Name], figure: str) -> Name:
    return names.get(figure) or Name(words(figure))


def _drawn(folder: Path, table: study_plots.Table, of: Experiment, figure: str, field: str, names: Mapping[str, Name]) -> str:
    """A plot for the page, kept as a PNG file too."""
    fields = list(table[0])[: list(table[0]).index(SEED)]
    drawn = study_plots.draw(table, figure, field, fields, of.limits[figure], of.limit, _name(names, figure))
    name = f"{figure}_over_{re.sub(r'[^A-Za-z0-9]+', '_', field)}.png"
    return kept_drawing(folder, name, drawn, f"{_name(names, figure).title} over {field}", f"{PICTURES}/{name}")


def kept_drawing(folder: Path, name: str, drawn: Figure, caption: str, detail: str) -> str:
    """A drawing for the page, kept as a PNG file too."""
    (folder / PICTURES).mkdir(exist_ok=True)
    with atomic.listed_file(folder, f"{PICTURES}/{name}", study_runs.BY) as path:
        drawn.savefig(path, dpi=160, metadata={"Software": None})
    return page.drawing(figures.inline_svg(drawn), caption, detail)


def _points(table: study_plots.Table, fields: Sequence[str], of: Experiment) -> Iterator[list[str]]:
    """A row a point of the design: its values, its trials, sums of counts, and medians of figures beside their closed forms."""
    for point in _distinct_points(table, fields)[:MOST_ROWS]:
        alike = [row for row in table if tuple(row[field] for field in fields) == point]
        sums = [shown(float(study_runs.finite(row.get(figure) for row in alike).sum()), ".6g") for figure in of.counts]
        cells = [_median(alike, figure) + (f" ({_median(alike, limit)})" if limit else "") for figure, limit in of.limits.items()]
        yield [*(short(value) for value in point), str(len(alike)), *sums, *cells]


def _median(rows: study_plots.Table, figure: str) -> str:
    known = study_runs.finite(row.get(figure) for row in rows)
    return shown(float(np.median(known)) if known.size else np.nan, ".4g")


def _distinct_points(table: study_plots.Table, fields: Sequence[str]) -> list[tuple[Any, ...]]:
    return list(dict.fromkeys(tuple(row[field] for field in fields) for row in table))


def labels(done: Sequence[Done]) -> list[str]:
    """Points of trials by the values that vary among them, as fields of the command line; by all where none does."""
    table, fields = study_runs.rows(done), list(done[0].trial.point)
    varied = [field for field in fields if len({row[field] for row in table}) > 1] or fields
    return [", ".join(f"{field}={short(one.trial.point[field])}" for field in varied) for one in done]


def named(one: Done, point: str) -> str:
    """A trial by a label of its point and its seed."""
    return f"{point}, seed={one.trial.seed}" if point else f"seed={one.trial.seed}"
