"""Rows of figures that a test has measured, with the bars of conf/bars."""

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

from twin.experiments import bars
from twin.experiments.bars import Experiment
from twin.experiments.result_rows import Row

CONF = Path(__file__).resolve().parents[3] / "conf"
FILES = sorted((CONF / "bars").glob("*/*.yaml"))


@cache
def experiments(path: Path) -> list[Experiment]:
    """All of a group."""
    return bars.read(path)


def rows(function: Callable, figures: Mapping[str, float], **settings) -> list[Row]:
    """Rows of an experiment, of the first entry with the same settings, as far as these are given."""
    of = f"{function.__module__}.{function.__name__}"
    entries = [one for path in FILES for one in experiments(path) if one.of == of and settings.items() <= one.settings.items()]
    return entries[0].rows(figures)


def missed(function: Callable, figures: Mapping[str, float], **settings) -> list[Row]:
    """Rows whose bar isn't met."""
    return [row for row in rows(function, figures, **settings) if row.met is False]
