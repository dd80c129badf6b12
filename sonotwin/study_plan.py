"""A study's plan: what conf/study says, what is given beside it, and the settings of each trial."""

import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import Field, ValidationError

from recon.errors import InputError, one_line, validated
from recon.files import yaml_text
from recon.model.rig import Part
from sonotwin import choices
from twin.experiments import experiment_runs
from twin.experiments.experiment_runs import Settings
from twin.studies import factors, study_runs
from twin.studies.beside_paper import Figure
from twin.studies.error_budget import Budget
from twin.studies.factors import Point
from twin.studies.rig_search import Goal
from twin.studies.shares import Shares
from twin.studies.study_runs import Trial

SWEEP = "sweep"  # the study that conf/study doesn't have: all of it is given
GROUPS = {  # fields that are choices of a group of conf/
    **{name: name for name in ("rig", "patterns", "poses", "conditions", "tracing", "ultrasound")},
    "board_patterns": "patterns",
}

Seeds = Annotated[int, Field(ge=1, le=10_000)]
Points = Annotated[int, Field(ge=1, le=1_000_000)]


class Study(Part):
    """A study of conf/study."""

    title: str
    of: str
    over: dict[str, Any]
    seeds: Seeds = 3
    points: Points | None = None
    search: Goal | None = None
    budget: Budget | None = None
    shares: Shares | None = None
    beside: tuple[Figure, ...] = ()  # figures of the paper
    fields: tuple[str, ...] = ()  # of conf/study.yaml, as on the command line


def read_study(name: object) -> Study | None:
    """Read a study by its name in conf/study or from a YAML file; None for a sweep, which has none.

    Raises
    ------
    InputError
        If there is no such file, it is not YAML, or a field is wrong.
    """
    if name == SWEEP:
        return None
    path = choices.file_of("study", str(name), "name")
    return validated(Study, yaml_text.read(path), path)


def trials(of: str, settings: Settings, points: Iterable[Point], seeds: Iterable[int]) -> list[Trial]:
    """Trials of all points and seeds, in order, with settings that are valid.

    Raises
    ------
    InputError
        If a field isn't one of the experiment's, or a value is nonsense.
    """
    points, base = list(points), settings.model_dump(mode="json")
    experiment_runs.check_reads(of, {name for point in points for names in point for name in names.split(factors.JOINT)})
    return study_runs.plan(of, [(point, changed(base, point)) for point in points], list(seeds))


def changed(base: Mapping[str, Any], point: Point) -> Settings:
    """Settings with a point's values; raises InputError that names the field of one that is nonsense."""
    chosen = {
        name: choice(name, value) if set(name.split(factors.JOINT)) <= set(GROUPS) and isinstance(value, str) else value
        for name, value in point.items()
    }
    try:
        return Settings.model_validate(factors.applied(base, chosen))
    except ValidationError as error:
        raise InputError(f"over: {', '.join(f'{name}={value}' for name, value in point.items())}: {one_line(error)}") from None


def choice(name: str, value: str) -> Any:
    """Content of a group's choice, such as `lifelike` of conditions, or of one part of it, such as `lifelike.sound`.

    A YAML file of one's own is a choice, too: `ours.yaml`, `ours.yaml.sound`.
    """
    whole = re.match(r".+\.ya?ml(?=\.|$)|[^.]*", value)
    assert whole is not None
    source, part = whole[0], value[whole.end() + 1 :]
    content = choices.read(GROUPS[name.split(factors.JOINT)[0]], source, f"over: {name}")
    if not part:
        return content
    if part not in content:
        raise InputError(f"over: {name}: expected {source}, or a part of it, {', '.join(content)}, found {value}")
    return {part: content[part]}
