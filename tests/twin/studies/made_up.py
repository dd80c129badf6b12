"""Trials whose figures are given, and an experiment that only adds: studies without their hours."""

from twin.experiments import experiment_runs
from twin.experiments.experiment_runs import Experiment, Settings
from twin.studies.study_runs import Done, Trial

NAME = "sum"


def done(point, figures, seed: int = 0) -> Done:
    """A trial that is done, of a point, with figures or an error."""
    return Done(Trial(f"{sorted(point.items())}{seed}", point, seed, None), figures)


def measure(settings: Settings, seed: int) -> dict[str, float]:
    """Figures of the probe's speed and the seed; none of a speed above 100, no second one of a speed above 50."""
    speed = settings.noise.speed_mm_s
    if speed > 100:
        raise ValueError(f"speed_mm_s: expected at most 100,\n  found {speed:g}")
    figures = {"sum_mm": speed + seed, "limit_mm": speed / 3}
    return figures if speed > 50 else figures | {"odd": float("nan") if seed % 2 else 1.0}


EXPERIMENT = Experiment(("noise", "layout"), measure, {"sum_mm": "limit_mm"})


def run_trial(key: str, name: str, settings: Settings, seed: int):
    """As that of `experiments`, in a worker that has no such experiment yet."""
    experiment_runs.MODULES[NAME] = __name__
    return experiment_runs.run_trial(key, name, settings, seed)
