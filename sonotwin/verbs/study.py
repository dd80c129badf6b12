"""Repeat an experiment over settings and seeds: a table of all figures, plots beside closed forms, a page.

Reads the study that `name` says from conf/study, or a YAML file of one's own; `name=sweep` needs `of`, the experiment, and
`over`, the fields to vary. Writes OUT/{table.parquet,report.html,figures/,study.json} and OUT/trials/, from which a run goes on
that was stopped, or has more values or seeds. A trial takes from a second (chain) to three minutes (laboratory, 34 poses), of
training six. `sonotwin study name=NAME --help` says what a study of conf/study is for.

    sonotwin study name=phase_steps out=outputs/phase_steps engine.workers=2
    sonotwin study name=sweep of=surface over='{shooting.exposure_s: [0.002, 0.004, 0.008]}' seeds=3 out=outputs/exposure
    sonotwin study name=better_rig out=outputs/better_rig engine.workers=2
    sonotwin study name=budget out=outputs/budget engine.workers=2
"""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, model_validator

from recon.model.rig import Part
from sonotwin import study_steps
from sonotwin.config import compose, defaults
from sonotwin.console_watch import LineConsole
from sonotwin.experiment_settings import settings_of
from sonotwin.study_plan import SWEEP, Points, Seeds, read_study
from twin.engine import Engine
from twin.experiments.experiment_runs import MODULES, Settings
from twin.studies.beside_paper import Figure
from twin.studies.error_budget import Budget
from twin.studies.factors import Filling
from twin.studies.rig_search import Goal
from twin.studies.shares import Shares
from twin.working_range import working_range


class Config(Part):
    """Fields of `conf/study.yaml`."""

    name: Annotated[str, Field(coerce_numbers_to_str=True)]
    out: Path
    trials: Path | None = None
    title: str = ""
    of: str
    over: dict[str, Any]
    seeds: Seeds = 3
    first_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    points: Points | None = None
    fill: Filling = "sobol"
    search: Goal | None = None
    budget: Budget | None = None
    shares: Shares | None = None
    beside: tuple[Figure, ...] = ()
    document: Path | None = None
    engine: Engine = Engine()
    given: tuple[str, ...] = ()  # on the command line
    settings: Settings  # of the experiment: all fields that are not above

    @model_validator(mode="before")
    @classmethod
    def _as_named(cls, given: Any, info: ValidationInfo) -> Any:
        """Take from the named study what isn't given, and gather the experiment's settings."""
        if not isinstance(given, dict) or "settings" in given:
            return given
        overrides = tuple((info.context or {}).get("overrides", ()))
        study = read_study(given["name"])
        if study is not None and study.fields and overrides:
            given = compose("study", [*study.fields, *overrides])
        own = {} if study is None else study.model_dump(exclude={"fields"})
        fields = {name: value for name, value in given.items() if name not in Settings.model_fields and value is not None}
        for name in ("search", "budget", "shares"):
            if own.get(name) and isinstance(fields.get(name), dict):
                fields[name] = own[name] | fields[name]
        for name in ("of", "over"):
            if name not in own | fields:
                raise ValueError(f"{name}: needs a value with name={SWEEP}; give {name}=...")
        return {**own, **fields, "given": overrides, "settings": settings_of(given)}

    @model_validator(mode="after")
    def _known(self) -> "Config":
        if self.of not in MODULES:
            raise ValueError(f"of: expected one of {', '.join(MODULES)}, found {self.of}")
        if not self.over and self.budget is None and (self.name == SWEEP or self.search is not None):
            raise ValueError(
                "over: expected a field with its values, as in over='{shooting.exposure_s: [0.004, 0.008]}', found none"
            )
        return self


def of_conf(name: str, out: Path, **fields: Any) -> Config:
    """A study of conf/study, or a sweep, with fields of its own, of the study or of the experiment's settings, as objects.

    Raises
    ------
    InputError
        If there is no such study.
    """
    study = read_study(name)
    composed = defaults("study", () if study is None else study.fields)
    return Config.model_validate(composed | {"name": name, "out": out} | fields)


def run(config: Config) -> int:
    """Do the trials that are missing, write table, plots and page; returns 1 if nothing came of it.

    Raises
    ------
    InputError
        If a factor isn't a field of the experiment, a value is nonsense, or `out` holds something else.
    """
    console = LineConsole()
    console.print(f"rig         {working_range(config.settings.rig).in_words()}", markup=False)
    if config.search is not None:
        return 0 if study_steps.search(config, config.search, console) else 1
    if config.budget is not None:
        return 0 if study_steps.budget(config, config.budget, console) else 1
    return 0 if study_steps.sweep(config, console) else 1
