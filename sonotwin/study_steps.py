"""What `sonotwin study` does: all points of a design, a search for the best, or an error budget; and what it writes and says."""

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import Progress

from recon.files.metrics import shown
from recon.reports import page
from recon.reports.page import Section
from sonotwin import study_plan
from twin.experiments import document_tables, experiment_runs
from twin.studies import (
    beside_paper,
    budget_page,
    error_budget,
    factors,
    rig_search,
    search_page,
    shares,
    shares_page,
    study_page,
    study_runs,
)
from twin.studies.error_budget import Budget
from twin.studies.factors import Point
from twin.studies.rig_search import Candidate, Goal
from twin.studies.study_runs import STUDY, TABLE, Done, StudyFolder, Trial, finite

FEWEST = 10  # trials of a search that are drawn over each factor; fewer are scattered over all of them

if TYPE_CHECKING:
    from sonotwin.verbs.study import Config


def sweep(config: "Config", console: Console) -> bool:
    """Do all points of a design; returns whether any trial gave figures."""
    trials = study_plan.trials(config.of, config.settings, design(config), seeds(config))
    if config.document is not None:
        document_tables.check_place(config.document, config.name)
    done = do(config, opened(config), trials, console)
    of = experiment_runs.experiment(config.of)
    for figure in of.counts:
        counted = finite(one.figures.get(figure) for one in done)
        console.print(f"count       {figure} {counted.sum():g} in {counted.size} trials", markup=False)
    for figure, limit in of.limits.items():
        sign = "± " if (finite(one.figures.get(figure) for one in done) < 0).any() else ""  # an error, beside a size
        beside = f", {of.limit} {sign}{_range(done, limit)}" if limit else ""
        console.print(f"figure      {figure} {_range(done, figure)}{beside}", markup=False)
    names = beside_paper.names(config.beside)
    sections = [*study_page.plots(config.out, done, of, names), study_page.points(done, of, names)]
    if config.shares is not None:
        for field, level, found in shares.by_level(config.shares, done):
            texts = (f"{text} {shares_page.in_words(found[name])} %" for name, text in config.shares.counts.items())
            console.print(f"share       {f'{field}={level}' if field else 'all'}: {', '.join(texts)}", markup=False)
        sections = [*shares_page.sections(config.out, config.shares, done), *sections]
    if config.beside:
        sections = [_beside_paper(config, done, console), *sections]
    write(config, done, sections, console)
    return any(one.figures for one in done)


def design(config: "Config") -> list[Point]:
    """All points of a sweep."""
    read = factors.read(config.over)
    return factors.factorial(read) if config.points is None else factors.filling(read, config.points, config.fill)


def _beside_paper(config: "Config", done: Sequence[Done], console: Console) -> Section:
    """The paper's figures beside those of its method and of ours: on the console, in a document if one is given, on the page."""
    compared = beside_paper.compare(config.beside, done)
    for one in compared:
        point, what, reported, paper, _, ours, limit, predicted, unit = beside_paper.cells(one)
        beside = (f"; limit of noise {limit}" if limit else "") + (f"; predicted for ours {predicted}" if predicted else "")
        console.print(f"{point:12}{what}: reported {reported}, its method {paper}, ours {ours}{beside} {unit}", markup=False)
    if config.document is not None:
        document_tables.refresh(config.document, config.name, beside_paper.markdown(compared))
    caption = (
        f"Means; in brackets the least, the greatest and the number of trials. Met: within a factor of {beside_paper.FACTOR:g}. "
        "Predicted for ours: by our software's covariances, with all that it can't exclude; no limit, so ours may be less."
    )
    meanings = map(page.paragraph, beside_paper.meanings(config.beside))
    return Section("Beside the paper", [page.table(beside_paper.HEAD, map(beside_paper.cells, compared), caption), *meanings])


def budget(config: "Config", wanted: Budget, console: Console) -> bool:
    """Turn each source on and off; returns whether all figures of the budget are there."""
    points = error_budget.points(wanted, config.settings.model_dump(mode="json"))
    trials = study_plan.trials(config.of, config.settings, points.values(), seeds(config))
    done = do(config, opened(config), trials, console)
    sums = error_budget.added_up(wanted, dict(zip(points, _split(done, config.seeds), strict=True)))
    for one in sums:
        console.print(f"budget      {wanted.figures[one.figure]}: {error_budget.explained(one)}", markup=False)
        for line in error_budget.advice(wanted, one)[:1]:
            console.print(f"mend first  {line}", markup=False)
    write(config, done, budget_page.sections(config.out, wanted, sums), console, _labels(points, done))
    return all(one.whole == one.whole for one in sums)


def _labels(points: Mapping[tuple[str, float], Point], done: Sequence[Done]) -> list[str]:
    """Of each trial the source that is on, instead of the many fields that are zero."""
    return [next(error_budget.label(*key) for key, point in points.items() if point == one.trial.point) for one in done]


def search(config: "Config", goal: Goal, console: Console) -> bool:
    """Search for the best values, and say which they are; returns whether a candidate kept all bounds."""
    read = factors.read(config.over)
    rig_search.check(goal, read)

    def trials_of(points: Iterable[Point]) -> list[Trial]:
        under = [point | some for point in points for some in rig_search.conditions(goal)]
        return study_plan.trials(config.of, config.settings, under, seeds(config))

    def attempt(points: Sequence[Point]) -> list[list[Done]]:
        trials = trials_of(points)
        done = study_runs.in_order(trials, list(study_runs.run(place, config.of, trials, config.engine)))
        return _split(done, len(trials) // len(points))

    def foresee(points: Sequence[Point]) -> list[list[Done]]:
        trials = trials_of(points)
        done = [Done(one, experiment_runs.predict_trial(config.of, one.settings, one.seed)) for one in trials]
        return _split(done, len(trials) // len(points))

    start = trials_of([goal.start])  # refused before anything is written
    if goal.by == "prediction":
        experiment_runs.predict_trial(config.of, start[0].settings, start[0].seed)
    place, candidates = opened(config), list[Candidate]()
    console.print(f"search      {goal.runs} candidates for the least {goal.least} over {', '.join(config.over)}", markup=False)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        if goal.by == "prediction":
            tried = rig_search.search_by_prediction(goal, read, foresee, attempt)
        else:
            tried = rig_search.search(goal, read, config.first_seed, attempt)
        candidates.extend(progress.track(tried, goal.runs, description="candidates"))
    found = rig_search.best(candidates)
    if goal.by == "prediction" and len(candidates) < goal.runs:
        rest = "none of the others is predicted to be better within bounds"
        console.print(f"tried       {len(candidates)}; {rest}", markup=False)
    for what, one in {"start": candidates[0] if goal.start else None, "best": found}.items():
        if one is not None:
            console.print(f"{what:12}{goal.least} {shown(one.value, '.4g')}: {', '.join(fields_of(one.point))}", markup=False)
    if goal.start and candidates[0].lost:
        console.print(f"no start    {search_page.no_start(candidates[0])}", markup=False)
    if found is None:
        console.print("no best     no candidate kept all bounds")
    done = [one for candidate in candidates for one in candidate.done]
    of = experiment_runs.experiment(config.of)
    courses = study_page.plots(config.out, done, of) if len(done) >= FEWEST else []
    sections = [*search_page.sections(config.out, goal, candidates), *courses, study_page.points(done, of)]
    write(config, done, sections, console)
    return found is not None


def _range(done: Sequence[Done], figure: str) -> str:
    """The least and the greatest value of a figure."""
    known = finite(one.figures.get(figure) for one in done)
    return f"{known.min():.4g} to {known.max():.4g}" if known.size else "unknown"


def seeds(config: "Config") -> range:
    """Seeds of each point's trials."""
    return range(config.first_seed, config.first_seed + config.seeds)


def opened(config: "Config") -> StudyFolder:
    """The study's folder, with a description of the study, which is its mark."""
    place = StudyFolder(config.out, config.trials)
    described = config.model_dump(mode="json", exclude={"out", "trials", "document", "given", "engine", "settings"})
    place.open(described | {"settings": experiment_runs.read_by(config.of, config.settings)})
    return place


def do(config: "Config", place: StudyFolder, trials: Sequence[Trial], console: Console) -> list[Done]:
    """Do the trials that are missing; gives all in order."""
    there = sum(place.kept(trial) is not None for trial in trials)
    over = f" over {', '.join(config.over)}" if config.over else ""
    console.print(f"study       {config.of}{over}: {len(trials)} trials, {there} of them there already", markup=False)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        running = study_runs.run(place, config.of, trials, config.engine)
        return study_runs.in_order(trials, list(progress.track(running, len(trials), description="trials")))


def write(
    config: "Config", done: Sequence[Done], sections: Sequence[Section], console: Console, labels: Sequence[str] | None = None
) -> None:
    """Write table and page, and say which trials gave no figures: by labels of their points, or by the values that vary."""
    labels = study_page.labels(done) if labels is None else labels
    for one, label in {one.found: (one, label) for one, label in zip(done, labels, strict=True) if one.failed}.values():
        console.print(f"no figures  {study_page.named(one, label)}: {one.found}", markup=False)
    StudyFolder(config.out).write_table(done)
    study_page.write(config.out, config.title or config.name, done, sections, [command(config)], labels)
    console.print(f"wrote       {config.out}/{{{TABLE},{study_page.PAGE},{study_page.PICTURES}/,{STUDY}}}", markup=False)


def command(config: "Config") -> str:
    """The command line that makes the study again."""
    return shlex.join(["sonotwin", "study", *config.given])


def fields_of(point: Point) -> Iterator[str]:
    """A point's values as fields of the command line."""
    return (f"{name}={value}" for name, value in point.items())


def _split(done: Sequence[Done], size: int) -> list[list[Done]]:
    """Trials, point by point."""
    return [list(done[first : first + size]) for first in range(0, len(done), size)]
