"""Repeat an experiment over settings and seeds: a table of all figures, plots beside closed forms, a page.

Reads the study that `name` says from conf/study, or a YAML file of one's own; `name=sweep` needs `of`, the experiment, and
`over`, the fields to vary. Writes OUT/{table.parquet,report.html,figures/,study.json} and OUT/trials/, from which a run goes on
that was stopped, or has more values or seeds. Trials take from seconds (surface) to a minute (laboratory, 34 poses).

    sonotwin study name=phase_steps out=outputs/phase_steps engine.workers=2
    sonotwin study name=sweep of=surface over='{shooting.exposure_s: [0.002, 0.004, 0.008]}' seeds=3 out=outputs/exposure
    sonotwin study name=better_rig out=outputs/better_rig engine.workers=2
"""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, model_validator
from rich.console import Console
from rich.progress import Progress

from recon.files.metrics import shown
from sonotwin import study_plan
from sonotwin.config import compose, folder
from sonotwin.study_plan import SWEEP, Points, Seeds, read_study
from twin.engine import Engine
from twin.studies import experiments, factors, rig_search, study_page, study_runs
from twin.studies.experiments import MODULES, Settings
from twin.studies.factors import Factor, Filling, Point
from twin.studies.rig_search import Candidate, Goal
from twin.studies.study_runs import STUDY, TABLE, Done, StudyFolder


class Config(BaseModel):
    """Fields of `conf/study.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    out: Path
    title: str = ""
    of: str
    over: dict[str, Any]
    seeds: Seeds = 3
    first_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    points: Points | None = None
    fill: Filling = "sobol"
    search: Goal | None = None
    engine: Engine = Engine()
    settings: Settings  # of the experiment: all fields that are not above

    @model_validator(mode="before")
    @classmethod
    def _as_named(cls, given: Any, info: ValidationInfo) -> Any:
        """Take from the named study what isn't given, and gather the experiment's settings."""
        if not isinstance(given, dict) or "settings" in given:
            return given
        study = read_study(given["name"])
        if study is not None and study.fields:
            given = compose("study", [*study.fields, *(info.context or {}).get("overrides", [])])
        own = {} if study is None else study.model_dump(exclude={"fields"})
        ranges = yaml.safe_load((folder() / "dataset.yaml").read_text(encoding="utf-8"))["ranges"]
        settings = {name: value for name, value in given.items() if name in Settings.model_fields} | {"ranges": ranges}
        fields = {name: value for name, value in given.items() if name not in Settings.model_fields and value is not None}
        for name in ("of", "over"):
            if name not in own | fields:
                raise ValueError(f"{name}: needs a value with name={SWEEP}; give {name}=...")
        return {**own, **fields, "settings": settings}

    @model_validator(mode="after")
    def _known(self) -> "Config":
        if self.of not in MODULES:
            raise ValueError(f"of: expected one of {', '.join(MODULES)}, found {self.of}")
        return self

    def seed_range(self) -> range:
        """Seeds of each point's trials."""
        return range(self.first_seed, self.first_seed + self.seeds)


def run(config: Config) -> int:
    """Do the trials that are missing, write table, plots and page; returns 1 if no trial gave figures, or none within bounds.

    Raises
    ------
    InputError
        If a factor isn't a field of the experiment, a value is nonsense, or `out` holds something else.
    """
    console = Console(soft_wrap=True, highlight=False)
    read, place = factors.read(config.over), StudyFolder(config.out)
    if config.search is not None:
        return search(config, config.search, read, place, console)
    points = factors.factorial(read) if config.points is None else factors.filling(read, config.points, config.fill, 0)
    trials = study_plan.trials(config.of, config.settings, points, config.seed_range())
    place.open(described(config))
    fresh = sum(place.kept(trial) is None for trial in trials)
    over = ", ".join(config.over) or "seeds"
    console.print(f"study       {config.of} over {over}: {len(trials)} trials, {len(trials) - fresh} there already", markup=False)
    done: list[Done] = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        for one in progress.track(study_runs.run(place, config.of, trials, config.engine), len(trials), description="trials"):
            done.append(one)
    write(config, place, study_runs.in_order(trials, done), console)
    return 0 if any(one.figures for one in done) else 1


def search(config: Config, goal: Goal, read: dict[str, Factor], place: StudyFolder, console: Console) -> int:
    """Search for the best values, and say which they are."""
    rig_search.check(goal, read)

    def attempt(points: Sequence[Point]) -> list[list[Done]]:
        under = [point | some for point in points for some in rig_search.conditions(goal)]
        trials = study_plan.trials(config.of, config.settings, under, config.seed_range())
        done = study_runs.in_order(trials, list(study_runs.run(place, config.of, trials, config.engine)))
        size = len(trials) // len(points)
        return [done[first : first + size] for first in range(0, len(done), size)]

    started = [goal.start | some for some in rig_search.conditions(goal)]
    study_plan.trials(config.of, config.settings, started, config.seed_range())  # before anything is written
    place.open(described(config))
    console.print(f"search      {goal.runs} candidates for the least {goal.least} over {', '.join(config.over)}", markup=False)
    candidates: list[Candidate] = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        for one in progress.track(rig_search.search(goal, read, config.first_seed, attempt), goal.runs, description="candidates"):
            candidates.append(one)
    found = rig_search.best(candidates)
    for what, one in {"start": candidates[0] if goal.start else None, "best": found}.items():
        if one is not None:
            console.print(f"{what:12}{goal.least} {shown(one.value, '.4g')}: {', '.join(fields_of(one.point))}", markup=False)
    if found is None:
        console.print("no best     no candidate kept all bounds")
    write(config, place, [done for one in candidates for done in one.done], console)
    return 0 if found is not None else 1


def write(config: Config, place: StudyFolder, done: Sequence[Done], console: Console) -> None:
    """Write table, plots and page, and say which points gave no figures."""
    for one in {str(one.found): one for one in done if isinstance(one.found, str)}.values():
        at = ", ".join([*fields_of(one.trial.point), f"seed={one.trial.seed}"])
        console.print(f"no figures  {at}: {one.found}", markup=False)
    place.write_table(done)
    limits = experiments.experiment(config.of).limits
    study_page.write(config.out, config.title or config.name, done, limits, [command(config)])
    console.print(f"wrote       {config.out}/{{{TABLE},{study_page.PAGE},{study_page.PICTURES}/,{STUDY}}}", markup=False)


def described(config: Config) -> dict[str, Any]:
    """The study as its folder's mark describes it."""
    return {
        **config.model_dump(mode="json", exclude={"out", "engine", "settings"}),
        "settings": experiments.read_by(config.of, config.settings),
    }


def command(config: Config) -> str:
    """The command line of a study, less the settings that it shares with conf/study.yaml."""
    over = yaml.safe_dump(config.over, default_flow_style=True, width=10**6).strip()
    fields = [f"name={config.name}", f"of={config.of}", f"over={over}", f"seeds={config.seeds}", f"out={config.out}"]
    return shlex.join(["sonotwin", "study", *fields])


def fields_of(point: Point) -> Iterator[str]:
    """A point's values as fields of the command line."""
    return (f"{name}={value}" for name, value in point.items())
