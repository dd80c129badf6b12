"""Experiments with bars: a YAML file says which are run with which settings, and of each figure its words, unit, bar and limit.

An experiment is a function of what all have at hand (`Setup`) and of settings of its own; it gives figures by name. So a group of
accuracy, and one of speed, is a list of such entries in `conf/bars/`.
"""

import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from recon.errors import InputError, validated
from recon.files import yaml_text
from recon.files.metrics import Metrics
from recon.model.part import Part
from twin.engine import Engine
from twin.experiments import experiment_runs, virtual_screen
from twin.experiments.experiment_setup import Figures, Setup, digest_of
from twin.experiments.kept_figures import UNKNOWN, Kept
from twin.experiments.result_rows import Row

OURS = "twin"  # package whose experiments depend on code and settings alone
Number = float | str | None  # a number, or a figure by its name, maybe as `1.25 limit_mm` or `limit_mm / 1.5`


class Known(dict[str, Any]):
    """Settings, words and figures by name, for texts and bars; it notes which were used."""

    def __init__(self, known: Mapping[str, Any], used: set[str]) -> None:
        super().__init__(known)
        self.used = used

    def __getitem__(self, name: str) -> Any:
        self.used.add(name)
        return super().__getitem__(name)


class _Unmeasured(dict[str, Any]):
    """Names in a text, of figures that nobody has measured, too."""

    def __missing__(self, name: str) -> "_Number":
        return _Number()


class _Number(float):
    """A number in a text, which may become any."""

    def __format__(self, form: str) -> str:
        return "\0"


class Figure(Part):
    """A figure's row; texts may have `{name}` of settings, of `each`, of figures, and `{about}` of the entry."""

    figure: str
    what: str
    unit: str = ""
    most: Number = None  # the bar
    least: Number = None  # the bar, where at least that is asked
    limit: Number = None
    each: dict[str, tuple[Any, ...]] = Field(default_factory=dict)  # values that the row is repeated for, in step
    optional: bool = False  # left out where the experiment has no such figure

    @model_validator(mode="after")
    def _one_bar_and_equal_lists(self) -> "Figure":
        if self.most is not None and self.least is not None:
            raise ValueError(
                f"expected one bar, most or least, found most: {self.most} and least: {self.least}; give each its row"
            )
        if len({len(values) for values in self.each.values()}) > 1:
            raise ValueError(
                f"each: expected lists of one length, found {', '.join(f'{len(v)} {k}' for k, v in self.each.items())}"
            )
        return self

    def rows(self, experiment: "Experiment", figures: Figures, used: set[str]) -> Iterator[Row]:
        """The rows of measured figures; notes the names that they use."""
        for given in self._given(experiment):
            names = set[str]()
            known = Known({**figures, **given}, names)
            known["about"] = experiment.about.format_map(known)
            name = self.figure.format_map(known)
            used |= names | {name}
            if self.optional and name not in figures:
                continue
            asked, limit = (_number(number, known) for number in (self.most if self.least is None else self.least, self.limit))
            sense, measured = "" if asked is None else "<=" if self.least is None else ">=", float(figures[name])
            for two in sorted(names & given.keys() & figures.keys()):
                if given[two] != figures[two]:
                    found = f"{given[two]} of the entry and {figures[two]} measured"
                    raise InputError(f"{experiment.place}: {self.figure}: {two}: expected one value, found {found}; rename one")
            used |= names
            met = None if asked is None else bool(measured <= asked if sense == "<=" else measured >= asked)
            settings = json.dumps(experiment.settings, sort_keys=True)
            yield Row(
                *(experiment.group, self.what.format_map(known), measured, sense, asked, limit, self.unit, met),
                **{"experiment": experiment.of, "settings": settings, "figure": name},
            )

    def texts(self, experiment: "Experiment") -> Iterator[re.Pattern[str]]:
        """What the texts of its rows may be, whatever the figures are."""
        for given in self._given(experiment):
            known = _Unmeasured(given)
            known["about"] = experiment.about.format_map(known)
            yield re.compile(re.escape(self.what.format_map(known)).replace("\0", r"([-+.\de]+|nan|inf)"))

    def _given(self, experiment: "Experiment") -> Iterator[dict[str, Any]]:
        """What a row's names stand for before anything is measured, row by row."""
        for values in zip(*self.each.values(), strict=True) if self.each else [()]:
            yield {**experiment.settings, **experiment.words, **dict(zip(self.each, values, strict=True))}


class Entry(Part):
    """An experiment in a group's file."""

    of: str  # dotted name of its function
    about: str = ""  # beginning of its rows
    over: dict[str, tuple[Any, ...]] = Field(default_factory=dict)  # settings whose combinations are measured one by one
    settings: dict[str, Any] = Field(default_factory=dict)
    words: dict[str, Any] = Field(default_factory=dict)  # that texts and bars may use, too
    needs: Literal["real", "screen", None] = None  # recordings, or a virtual screen; left out without
    kept: bool = True  # false for figures of a machine and a moment, times above all: measured in each run, here and alone
    draws: tuple[str, ...] = ()  # pictures in the folder of results, without which it is measured again
    every: str = ""  # pattern of figures that are as many as something else has parts: each must be in a row, a text or a bar
    rows: tuple[Figure, ...]


@dataclass(frozen=True)
class Experiment:
    """One measurement: a function with its settings, and the rows of its figures."""

    group: str
    of: str
    about: str
    settings: Mapping[str, Any]
    words: Mapping[str, Any]
    needs: str | None
    figures: tuple[Figure, ...]
    kept: bool = True
    draws: tuple[str, ...] = ()
    place: str = ""  # file and number of its entry
    every: str = ""

    @property
    def function(self) -> Callable[..., Figures]:
        """What measures."""
        module, _, name = self.of.rpartition(".")
        return getattr(import_module(module), name)

    def lacks(self, setup: Setup) -> str:
        """Name what it needs that isn't there; empty if all is."""
        if self.needs == "real" and setup.real is None:
            return "recordings, as real=FOLDER"
        return "a virtual screen, as Xvfb" if self.needs == "screen" and not virtual_screen.installed() else ""

    def gives(self, what: str) -> bool:
        """Whether a row's text is one of its."""
        return any(text.fullmatch(what) for figure in self.figures for text in figure.texts(self))

    def keeps(self) -> bool:
        """Whether its figures depend on code, settings and inputs alone; commands' own experiments keep their parts."""
        return self.kept and self.of.startswith(f"{OURS}.")

    def has_drawn(self, setup: Setup) -> bool:
        """Whether all pictures are there that it draws."""
        return setup.out is None or all((setup.out / name).is_file() for name in self.draws)

    def rows(self, figures: Figures) -> list[Row]:
        """Rows of figures that were measured.

        Raises
        ------
        InputError
            If a row's text or bar has a name that there is none of, or a figure that `every` asks for is in none of them.
        """
        rows, used = [], set[str]()
        for one in self.figures:
            try:
                rows += one.rows(self, figures, used)
            except (KeyError, IndexError, ValueError) as error:
                expected = f"expected names of its settings, words and figures, which are {', '.join(figures)}"
                raise InputError(f"{self.place}: {one.figure}: {expected}; found {error}") from error
        if left := [name for name in figures if fnmatchcase(name, self.every) and name not in used]:
            expected = f"expected a row for each figure like {self.every}"
            raise InputError(
                f"{self.place}: {expected}, found none for {', '.join(left)}; add it to a row's `each`, or change `every`"
            )
        return rows

    def key(self, setup: Setup) -> str:
        """Digest of all that its figures depend on."""
        return digest_of([experiment_runs.version(), self.of, self.settings, setup.digest])


def read(path: Path) -> list[Experiment]:
    """Read a group, `conf/bars/accuracy/GROUP.yaml`; raises InputError with the field that is wrong."""
    places = {f"{path}: entry {k + 1}": entry for k, entry in enumerate(yaml_text.read(path))}
    entries = {place: validated(Entry, entry, place) for place, entry in places.items()}
    return [
        Experiment(
            *(path.stem, one.of, one.about, one.settings | dict(zip(one.over, values, strict=True)), one.words, one.needs),
            *(one.rows, one.kept, one.draws, place, one.every),
        )
        for place, one in entries.items()
        for values in itertools.product(*one.over.values())
    ]


def measure(experiments: Sequence[Experiment], setup: Setup, kept: Kept | None, engine: Engine) -> Iterator[Row]:
    """Measure what lacks nothing, and give the rows in the order of the file as soon as they are there.

    kept : for experiments that keep their figures; its state is that of the rows, of kept ones the state that they were kept with
    """
    there = [one for one in experiments if not one.lacks(setup)]
    keys = {id(one): one.key(setup) for one in there if one.keeps()} if kept else {}
    tasks = {keys[id(one)]: (one, setup) for one in there if id(one) in keys}
    for key, (one, _) in tasks.items():
        if kept and not one.has_drawn(setup):
            kept.forget(key)
    running, done = kept.run(engine, _figures, tasks) if kept else iter(()), dict[str, Any]()
    for one in there:
        key, state = keys.get(id(one)), kept.state if kept else UNKNOWN
        if kept and key:
            while key not in done:
                done |= [next(running)]
            found, state = done[key], kept.state_of(key)
        else:
            done |= running  # to the end, so that no worker takes a part of this machine's time
            found = one.function(setup, **one.settings)
        yield from (replace(row, day=state.day, commit=state.commit) for row in one.rows(found))


def _figures(key: str, one: Experiment, setup: Setup) -> tuple[str, Metrics]:
    """Measure on any machine that has the code of who asks; raises InputError as `same_code` does."""
    with experiment_runs.same_code(key, one.key(setup)):
        return key, {name: float(value) for name, value in one.function(setup, **one.settings).items()}


def _number(given: Number, known: Known) -> float | None:
    """A number as it is given, or of a figure."""
    if not isinstance(given, str):
        return given
    if (name := given.format_map(known)) in known:
        return float(known[name])
    product, _, divisor = name.partition(" / ")
    factor, _, name = product.rpartition(" ")
    return float(factor or 1) * float(known[name]) / float(divisor or 1)
