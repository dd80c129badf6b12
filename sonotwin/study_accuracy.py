"""Accuracy of studies, in a reduced form: the paper's optics by both methods, closed forms, budget, search, engines.

Studies are those of conf/study with few seeds. Their trials are kept beside the tables, so that a measurement that was stopped
goes on where it was.
"""

from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from rich.console import Console

from recon.errors import InputError
from sonotwin import choices, study_plan, study_steps
from sonotwin.choices import read_rig
from sonotwin.verbs.study import Config, of_conf
from twin.engine import Engine
from twin.experiments import experiment_runs
from twin.experiments.table_rows import Measurement, Row, Setup
from twin.optics.surface_session import Shooting
from twin.studies import beside_paper, error_budget, factors, rig_search
from twin.studies.study_runs import TABLE, Done, finite

RIG = "meza2021"
SEEDS = 3
BUDGET_SEEDS = 24  # a second each; a contribution is then known to 14 %
PAPER = ("optics", "planes", "sphere", "probe", "cylinders", "breast")
POSES = "demo"  # of the board: 10 instead of 34
EXPLORATIONS = ("phase_steps", "fringe_pitch", "projector_distance", "exposure", "board_poses", "target_size")
SEARCHED = {  # a smaller space than that of conf/study/better_rig.yaml, which is searched whole too
    "patterns.parts.fringes.pitch": [6, 9, 12, 18, 27],
    "patterns.parts.fringes.steps": [4, 5, 6, 8],
    "layout.projector_mm": [60, 100, 165, 220],
}
POOR = {"patterns.parts.fringes.pitch": 27, "patterns.parts.fringes.steps": 4, "layout.projector_mm": 60}
DARK = Shooting(exposure_s=0.004)
BOUNDS = {"images_s": {"most": 0.03}, "coverage": {"least": 0.9}}
WORKERS = 2


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group.

    Raises
    ------
    InputError
        For another rig than the default one: studies read theirs from conf/rig.
    """
    if setup.rig != read_rig(RIG):
        raise InputError(f"accuracy: rig: expected {RIG} for only=studies, found another")
    kept = (setup.out or Path(mkdtemp(prefix="studies"))) / "studies"
    return [
        lambda: laboratories(kept),
        lambda: budget(kept),
        *(lambda name=name: exploration(kept, name) for name in EXPLORATIONS),
        lambda: search(kept),
        lambda: engines(kept),
    ]


def study(kept: Path, name: str, **fields: Any) -> tuple[Config, list[Done]]:
    """A study of conf/study with fields of its own, its trials done or kept."""
    config = of_conf(name, kept / name, trials=kept / "trials", engine=Engine(workers=WORKERS), **fields)
    if config.budget is not None:
        points = error_budget.points(config.budget, config.settings.model_dump(mode="json")).values()
    else:
        points = study_steps.design(config)
    trials = study_plan.trials(config.of, config.settings, list(points), study_steps.seeds(config))
    return config, study_steps.do(config, study_steps.opened(config), trials, Console(quiet=True))


def laboratories(kept: Path) -> list[Row]:
    """Rows a and b: the paper's figures under lifelike conditions, by our method and by the paper's."""
    rows, few = [], choices.read("poses", POSES)
    for name in PAPER:
        config, done = study(kept, name, seeds=SEEDS, poses=few, over={"conditions": ["lifelike"]})
        for one in beside_paper.compare(config.beside, done):
            what, unit = one.figure.what, one.figure.unit
            if one.figure.bar is not None:
                what_worst = f"{what}, {len(one.ours)} laboratories, worst"
                what_worst += "; predicted by the software's covariances" if one.figure.predicted else ""
                known = one.predicted if one.figure.predicted else one.limit if one.figure.limit else None
                rows.append(Row("a", what_worst, one.worst, one.figure.bar, known, unit, at_least=one.figure.at_least))
            if one.paper.size and one.figure.reported is not None and not one.figure.fitted:
                (low, high), factor = one.figure.reported, one.figure.factor
                by = f"{what} by the paper's method, mean (paper: {low:g} to {high:g})"
                rows.append(Row("b", f"{by}, at least", one.paper.mean(), low / factor, low, unit, at_least=True))
                rows.append(Row("b", f"{by}, at most", one.paper.mean(), high * factor, high, unit))
    return rows


def budget(kept: Path) -> list[Row]:
    """Row c: sums of parts against the whole, and predictions against switching."""
    config, done = study(kept, "budget", seeds=BUDGET_SEEDS)
    assert config.budget is not None
    points = error_budget.points(config.budget, config.settings.model_dump(mode="json"))
    size, rows = config.seeds, []
    sums = error_budget.added_up(config.budget, {key: done[k * size : (k + 1) * size] for k, key in enumerate(points)})
    for one in sums:
        what = f"budget of {config.budget.figures[one.figure]}, {size} seeds"
        off = abs(one.added / one.whole - 1)
        rows.append(Row("c", f"{what}: sum in squares over the whole, off from 1", off, 0.2, 0.0, ""))
        for names, (known, switched) in one.predicted.items():
            predicted = f"{what}: predicted by {names}, over switching, off from 1"
            rows.append(Row("c", predicted, abs(known / switched - 1), 0.25, 0.0, ""))
    return rows


def exploration(kept: Path, name: str) -> list[Row]:
    """Row d: figures of an exploration over what they are held against, the median over its trials and the largest."""
    config, done = study(kept, name, seeds=SEEDS, **({"poses": choices.read("poses", POSES)} if name == "board_poses" else {}))
    rows = []
    of = experiment_runs.experiment(config.of)
    for figure, limit in of.limits.items():
        if limit:
            ratios = finite(one.figures.get(figure, np.nan) / one.figures.get(limit, np.nan) for one in done)
            what = f"{config.title}: {figure} over what it is held against ({of.limit}), {len(ratios)} trials"
            rows.append(Row("d", f"{what}, median", float(np.median(ratios)), None, 1.0, ""))
            rows.append(Row("d", f"{what}, largest", float(ratios.max()), None, 1.0, ""))
    return rows


def search(kept: Path) -> list[Row]:
    """Row e: a search from a poor rig against all combinations."""
    config, done = study(kept, "sweep", of="surface", over=SEARCHED, seeds=1, shooting=DARK)
    read = factors.read(config.over)
    runs = len(done) // 4
    goal = rig_search.Goal.model_validate({"least": "plane_rms_mm", "runs": runs, "start": POOR, "bounds": BOUNDS})
    known = {tuple(one.trial.point.values()): one for one in done}
    tried = list(rig_search.search(goal, read, 0, lambda points: [[known[tuple(point.values())]] for point in points]))
    found = rig_search.best(tried)
    possible = rig_search.best([rig_search.judged(goal, read, one.trial.point, [one]) for one in done])
    assert possible is not None
    what = f"search of {len(done)} rigs in {runs} runs, from {tried[0].value:.3f} mm: found, over the best of all"
    return [Row("e", what, found.value / possible.value if found else np.nan, 1.05, 1.0, "")]


def engines(kept: Path) -> list[Row]:
    """Row f: tables of one process, two processes and Dask, byte by byte."""
    tables = []
    for number, engine in enumerate((Engine(workers=1), Engine(workers=2), Engine(name="dask", workers=2))):
        place, over = kept / f"engine{number}", {"shooting.exposure_s": [0.004, 0.016]}
        config = of_conf("sweep", place, of="surface", over=over, seeds=1, engine=engine)
        trials = study_plan.trials(config.of, config.settings, study_steps.design(config), study_steps.seeds(config))
        folder = study_steps.opened(config)
        folder.write_table(study_steps.do(config, folder, trials, Console(quiet=True)))
        tables.append((place / TABLE).read_bytes())
    alike = float(all(table == tables[0] for table in tables))
    what = "tables by one process, two processes and Dask's workers are the same bytes"
    return [Row("f", what, alike, 1.0, 1.0, "", at_least=True)]
