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
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.surface_session import Shooting
from twin.studies import beside_paper, error_budget, factors, rig_search
from twin.studies.study_runs import TABLE, Done, finite

RIG = "meza2021"
SEEDS = 3
BUDGET_SEEDS = 24  # a second each; a contribution is then known to 14 %
POSES = "demo"  # of the board: 10 instead of 34
SEARCHED = {  # a smaller space than that of conf/study/better_rig.yaml, which is searched whole too
    "patterns.parts.fringes.pitch": [6, 9, 12, 18, 27],
    "patterns.parts.fringes.steps": [4, 5, 6, 8],
    "layout.projector_mm": [60, 100, 165, 220],
}
POOR = {"patterns.parts.fringes.pitch": 27, "patterns.parts.fringes.steps": 4, "layout.projector_mm": 60}
DARK = Shooting(exposure_s=0.004)
BOUNDS = {"images_s": {"most": 0.03}, "coverage": {"least": 0.9}}
WORKERS = 2


def kept_in(setup: Setup) -> Path:
    """The folder of studies and their trials."""
    return (setup.out or Path(mkdtemp(prefix="studies"))) / "studies"


def kept_study(setup: Setup, name: str, **fields: Any) -> tuple[Config, list[Done]]:
    """A study of conf/study with fields of its own.

    Raises
    ------
    InputError
        For another rig than the default one: studies read theirs from conf/rig.
    """
    if setup.rig != read_rig(RIG):
        raise InputError(f"accuracy: rig: expected {RIG} for only=studies, found another")
    return study(kept_in(setup), name, **fields)


def study(kept: Path, name: str, **fields: Any) -> tuple[Config, list[Done]]:
    """A study of conf/study with fields of its own, its trials done or kept."""
    config = of_conf(name, kept / name, trials=kept / "trials", engine=Engine(workers=WORKERS), **fields)
    if config.budget is not None:
        points = error_budget.points(config.budget, config.settings.model_dump(mode="json")).values()
    else:
        points = study_steps.design(config)
    trials = study_plan.trials(config.of, config.settings, list(points), study_steps.seeds(config))
    return config, study_steps.do(config, study_steps.opened(config), trials, Console(quiet=True))


def laboratories(setup: Setup, study: str) -> Figures:
    """The paper's figures in a study of its laboratories under lifelike conditions, by our method and by the paper's.

    Named by what the study calls them: ours in the worst laboratory, its bar and what it is held against; the mean by the paper's
    method, and between which it is to be.
    """
    few, over = choices.read("poses", POSES), {"conditions": ["lifelike"]}
    config, done = kept_study(setup, study, seeds=SEEDS, poses=few, over=over)
    figures: Figures = {"laboratories": len(done)}
    for one in beside_paper.compare(config.beside, done):
        what = one.figure.what
        if one.figure.bar is not None:
            figures |= {f"{what}: worst": one.worst, f"{what}: bar": one.figure.bar}
            figures |= {f"{what}: limit": one.predicted if one.figure.predicted else one.limit}
        if one.paper.size and one.figure.reported is not None and not one.figure.fitted:
            (low, high), factor = one.figure.reported, one.figure.factor
            figures |= {f"{what}: paper": one.paper.mean(), f"{what}: low": low, f"{what}: high": high}
            figures |= {f"{what}: least": low / factor, f"{what}: most": high * factor}
    return figures


def budget(setup: Setup) -> Figures:
    """Sums of parts against the whole, and predictions against switching, off from 1, by the study's figures."""
    config, done = kept_study(setup, "budget", seeds=BUDGET_SEEDS)
    assert config.budget is not None
    points = error_budget.points(config.budget, config.settings.model_dump(mode="json"))
    size, figures = config.seeds, Figures(seeds=config.seeds)
    sums = error_budget.added_up(config.budget, {key: done[k * size : (k + 1) * size] for k, key in enumerate(points)})
    for one in sums:
        figures[one.figure] = abs(one.added / one.whole - 1)
        for names, (known, switched) in one.predicted.items():
            figures[config.budget.predicted[one.figure][names]] = abs(known / switched - 1)
    return figures


def exploration(setup: Setup, study: str) -> Figures:
    """Figures of an exploration over what they are held against, the median over its trials and the largest."""
    few = {"poses": choices.read("poses", POSES)} if study == "board_poses" else {}
    config, done = kept_study(setup, study, seeds=SEEDS, **few)
    figures: Figures = {}
    for figure, limit in experiment_runs.experiment(config.of).limits.items():
        if limit:
            ratios = finite(one.figures.get(figure, np.nan) / one.figures.get(limit, np.nan) for one in done)
            figures |= {"trials": len(ratios), f"{figure}: median": np.median(ratios), f"{figure}: largest": ratios.max()}
    return figures


def search(setup: Setup) -> Figures:
    """A search from a poor rig against all combinations."""
    config, done = kept_study(setup, "sweep", of="surface", over=SEARCHED, seeds=1, shooting=DARK)
    read = factors.read(config.over)
    runs = len(done) // 4
    goal = rig_search.Goal.model_validate({"least": "plane_rms_mm", "runs": runs, "start": POOR, "bounds": BOUNDS})
    known = {tuple(one.trial.point.values()): one for one in done}
    tried = list(rig_search.search(goal, read, 0, lambda points: [[known[tuple(point.values())]] for point in points]))
    found = rig_search.best(tried)
    possible = rig_search.best([rig_search.judged(goal, read, one.trial.point, [one]) for one in done])
    assert possible is not None
    ratio = found.value / possible.value if found else np.nan
    return {"rigs": len(done), "runs": runs, "start_mm": tried[0].value, "ratio": ratio}


def engines(setup: Setup) -> Figures:
    """Tables of one process, two processes and Dask, byte by byte."""
    tables = []
    for number, engine in enumerate((Engine(workers=1), Engine(workers=2), Engine(name="dask", workers=2))):
        place, over = kept_in(setup) / f"engine{number}", {"shooting.exposure_s": [0.004, 0.016]}
        config = of_conf("sweep", place, of="surface", over=over, seeds=1, engine=engine)
        trials = study_plan.trials(config.of, config.settings, study_steps.design(config), study_steps.seeds(config))
        folder = study_steps.opened(config)
        folder.write_table(study_steps.do(config, folder, trials, Console(quiet=True)))
        tables.append((place / TABLE).read_bytes())
    return {"alike": all(table == tables[0] for table in tables)}
