"""Repeat an experiment over settings and seeds: a table of all figures, plots beside closed forms, a page.

Reads the study that `name` says from conf/study, or a YAML file of one's own; `name=sweep` needs `of`, the experiment, and
`over`, the fields to vary. Writes OUT/{table.parquet,report.html,figures/,study.json} and OUT/trials/, from which a run goes on
that was stopped, or has more values or seeds. Trials take from seconds (surface) to a minute (laboratory, 34 poses).

    sonotwin study name=phase_steps out=outputs/phase_steps engine.workers=2
    sonotwin study name=sweep of=surface over='{shooting.exposure_s: [0.002, 0.004, 0.008]}' seeds=3 out=outputs/exposure
"""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, model_validator
from rich.console import Console
from rich.progress import Progress

from recon.capture.manifest import validated
from recon.errors import InputError, one_line
from recon.files.code_digest import code_digest
from recon.files.regular import read_bytes
from recon.model.rig import Part
from sonotwin.config import compose, folder
from twin.engine import Engine
from twin.studies import experiments, factors, study_page, study_runs
from twin.studies.experiments import MODULES, Settings
from twin.studies.factors import Filling, Point
from twin.studies.study_runs import STUDY, TABLE, Done, StudyFolder, Trial

GROUPS = {name: name for name in ("rig", "patterns", "poses", "conditions", "tracing", "ultrasound")} | {
    "board_patterns": "patterns"
}
SWEEP = "sweep"
CODE = ("recon", "scenes", "twin")  # packages by whose code figures are made


class Study(Part):
    """A study of conf/study."""

    title: str
    of: str
    over: dict[str, Any]
    seeds: Annotated[int, Field(ge=1, le=10_000)] = 3
    points: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    fields: tuple[str, ...] = ()  # of conf/study.yaml, as on the command line


class Config(BaseModel):
    """Fields of `conf/study.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    out: Path
    title: str = ""
    of: str
    over: dict[str, Any]
    seeds: Annotated[int, Field(ge=1, le=10_000)] = 3
    first_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    points: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    fill: Filling = "sobol"
    engine: Engine = Engine()
    settings: Settings

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
        settings = {name: value for name, value in given.items() if name in Settings.model_fields} | {"ranges": ranges()}
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


def read_study(name: str) -> Study | None:
    """Read a study by its name in conf/study or from a YAML file; None for a sweep, which has none."""
    if name == SWEEP:
        return None
    known = folder() / "study" / f"{name}.yaml"
    path = known if known.is_file() else Path(name)
    if path.suffix not in (".yaml", ".yml"):
        names = sorted(each.stem for each in known.parent.glob("*.yaml"))
        raise InputError(f"study: name: expected {SWEEP}, one of {', '.join(names)}, or a YAML file, found {name}")
    try:
        content = yaml.safe_load(read_bytes(path))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected YAML, found {' '.join(str(error).split())}") from None
    return validated(Study, content, path)


def ranges() -> dict[str, Any]:
    """Ranges of tracking frames, as conf/dataset.yaml has them."""
    return yaml.safe_load((folder() / "dataset.yaml").read_text(encoding="utf-8"))["ranges"]


def run(config: Config) -> int:
    """Do the trials that are missing, write table, plots and page; returns 1 if no trial gave figures.

    Raises
    ------
    InputError
        If a factor isn't a field of the experiment, a value is nonsense, or `out` holds something else.
    """
    console = Console(soft_wrap=True, highlight=False)
    trials = plan(config)
    place = StudyFolder(config.out)
    place.open({"name": config.name, "of": config.of, "over": config.over, "settings": read_by(config)})
    fresh = sum(place.kept(trial) is None for trial in trials)
    over = ", ".join(config.over) or "seeds"
    console.print(f"study       {config.of} over {over}: {len(trials)} trials, {len(trials) - fresh} there already", markup=False)
    done: list[Done] = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        for one in progress.track(study_runs.run(place, config.of, trials, config.engine), len(trials), description="trials"):
            done.append(one)
    done = study_runs.in_order(trials, done)
    for one in {str(one.found): one for one in done if isinstance(one.found, str)}.values():
        console.print(f"no figures  {_at(one.trial)}: {one.found}", markup=False)
    place.write_table(done)
    limits = experiments.experiment(config.of).limits
    study_page.write(config.out, config.title or config.name, done, limits, [command(config)])
    console.print(f"wrote       {config.out}/{{{TABLE},{study_page.PAGE},{study_page.PICTURES}/,{STUDY}}}", markup=False)
    return 0 if any(one.figures for one in done) else 1


def plan(config: Config) -> list[Trial]:
    """All trials, with settings that are valid."""
    experiments.check_reads(config.of, {name: None for names in config.over for name in names.split(factors.JOINT)})
    read = factors.read(config.over)
    points = (
        factors.factorial(read) if config.points is None else factors.filling(read, config.points, config.fill, config.first_seed)
    )
    base = config.settings.model_dump(mode="json")
    seeds = range(config.first_seed, config.first_seed + config.seeds)
    return study_runs.plan(config.of, [(point, changed(base, point)) for point in points], seeds, code_digest(*CODE))


def changed(base: Mapping[str, Any], point: Point) -> Settings:
    """Settings with a point's values; raises InputError that names the field of one that is nonsense."""
    chosen = {name: choice(name, value) if name in GROUPS and isinstance(value, str) else value for name, value in point.items()}
    try:
        return Settings.model_validate(factors.applied(base, chosen))
    except ValidationError as error:
        raise InputError(f"over: {', '.join(f'{name}={value}' for name, value in point.items())}: {one_line(error)}") from None


def choice(name: str, value: str) -> Any:
    """Content of a group's choice, such as `lifelike` of conditions."""
    path = folder() / GROUPS[name] / f"{value}.yaml"
    if not path.is_file():
        names = ", ".join(sorted(each.stem for each in path.parent.glob("*.yaml")))
        raise InputError(f"over: {name}: expected one of {names}, found {value}")
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def read_by(config: Config) -> dict[str, Any]:
    """The settings that the experiment reads, as JSON has them."""
    return experiments.read_by(config.of, config.settings)


def command(config: Config) -> str:
    """The command line of a study, less the settings that it shares with conf/study.yaml."""
    over = yaml.safe_dump(config.over, default_flow_style=True, width=10**6).strip()
    fields = [f"name={config.name}", f"of={config.of}", f"over={over}", f"seeds={config.seeds}", f"out={config.out}"]
    return shlex.join(["sonotwin", "study", *fields])


def _at(trial: Trial) -> str:
    return ", ".join([*(f"{name}={value}" for name, value in trial.point.items()), f"seed={trial.seed}"])
