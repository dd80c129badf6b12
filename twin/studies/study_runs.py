"""Trials of a study in its folder: each is kept as it is done, so that a study that was stopped, or grows, goes on.

`OUT/study.json` describes the study and is the folder's mark, `OUT/trials/KEY.json` holds a trial's figures by a digest of all
that they depend on, and `OUT/table.parquet` has a row a trial.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from recon.files import atomic
from recon.files.metrics import Metrics
from twin.engine import Engine
from twin.experiments import experiment_runs
from twin.experiments.experiment_runs import Settings
from twin.experiments.kept_figures import Kept
from twin.studies.factors import Point

STUDY, TABLE, TRIALS = "study.json", "table.parquet", "trials"
BY = "study"  # who writes
ERROR = "error"  # of a trial: in one line why it has no figures
SEED = "seed"


@dataclass(frozen=True)
class Trial:
    """One run of an experiment."""

    key: str
    point: Point  # of the design: values of its factors
    seed: int
    settings: Settings


@dataclass(frozen=True)
class Done:
    """A trial and its figures, or why there are none."""

    trial: Trial
    found: Metrics | str

    @property
    def failed(self) -> bool:
        """Whether there is a reason instead of figures."""
        return isinstance(self.found, str)

    @property
    def figures(self) -> Metrics:
        """Figures by name; none of a trial that failed."""
        return {} if isinstance(self.found, str) else self.found


@dataclass(frozen=True)
class StudyFolder:
    """The folder of one study."""

    folder: Path
    shared: Path | None = None  # folder of trials that several studies share; OUT/trials if not given

    @property
    def trials(self) -> Path:
        """Where trials are kept."""
        return self.shared or self.folder / TRIALS

    @property
    def figures(self) -> Kept:
        """Their figures."""
        return Kept(self.trials)

    def open(self, description: Mapping[str, Any]) -> None:
        """Begin or go on with a study; raises InputError if the folder holds something else."""
        atomic.check_filled_folder(self.folder, BY)
        atomic.begin_filled(self.folder, BY)
        self.figures.open()
        with atomic.listed_file(self.folder, STUDY, BY) as path:
            path.write_text(json.dumps(description, indent=1, sort_keys=True) + "\n", encoding="utf-8")

    def kept(self, trial: Trial) -> Done | None:
        """A trial that was done before, if it is whole."""
        found = self.figures.read(trial.key)
        return None if found is None else Done(trial, found)

    def write_table(self, done: Sequence[Done]) -> None:
        """Write a row a trial: its factors, its seed, its figures, and the error of one that has none."""
        with atomic.listed_file(self.folder, TABLE, BY) as path:
            pq.write_table(pa.Table.from_pylist(rows(done)), path)


def plan(name: str, points: Sequence[tuple[Point, Settings]], seeds: Sequence[int]) -> list[Trial]:
    """Trials of all points : (values, settings with these) and seeds, in order."""
    return [
        Trial(experiment_runs.digest(name, changed, seed), point, seed, changed) for point, changed in points for seed in seeds
    ]


def run(folder: StudyFolder, name: str, trials: Sequence[Trial], engine: Engine) -> Iterator[Done]:
    """Do the trials that aren't kept, and give all of them as they are done."""
    alike: dict[str, list[Trial]] = {}  # where a factor changes nothing
    for trial in trials:
        alike.setdefault(trial.key, []).append(trial)
    tasks = {key: (name, some[0].settings, some[0].seed) for key, some in alike.items()}
    for key, found in folder.figures.run(engine, experiment_runs.run_trial, tasks):
        yield from (Done(trial, found) for trial in alike[key])


def in_order(trials: Sequence[Trial], done: Sequence[Done]) -> list[Done]:
    """Trials that are done, in the order of their plan."""
    place = {id(trial): k for k, trial in enumerate(trials)}
    return sorted(done, key=lambda one: place[id(one.trial)])


def rows(done: Sequence[Done]) -> list[dict[str, Any]]:
    """A table's rows, all with the same columns; a column of mixed values holds words."""
    figures = list(dict.fromkeys(name for one in done for name in one.figures))
    kinds = {
        field: {type(cell(one.trial.point[field])) for one in done} - {type(None)}
        for field in (done[0].trial.point if done else ())
    }
    worded = {field for field, found in kinds.items() if str in found or len(found) > 1}
    return [
        {
            **{field: str(cell(value)) if field in worded else cell(value) for field, value in one.trial.point.items()},
            SEED: one.trial.seed,
            **{name: float(one.figures.get(name, math.nan)) for name in figures},
            ERROR: one.found if isinstance(one.found, str) else None,
        }
        for one in done
    ]


def finite(values: Iterable[Any]) -> NDArray[np.float64]:
    """Those of values that are finite numbers : (n,)."""
    found = np.array([np.nan if value is None else value for value in values], float)
    return found[np.isfinite(found)]


def numeric(values: Sequence[Any]) -> bool:
    """Whether all values are numbers."""
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def cell(value: Any) -> Any:
    """A factor's value as a column holds it: numbers and words as they are, all else as JSON."""
    if isinstance(value, bool | str) or value is None:
        return value
    return float(value) if isinstance(value, int | float) else json.dumps(value)
