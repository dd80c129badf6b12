"""The paper's experiments in a reduced form: one laboratory, few poses of the board, both methods on the same images."""

import pytest

from recon.model.patterns import Fringes, Patterns
from sonotwin import choices, study_accuracy
from tests.twin.small_rigs import half
from twin.experiments import probe_accuracy, tank_trial, tube_accuracy
from twin.experiments.drawn_session import ROLL_DEG
from twin.optics.light_transport import Tracing
from twin.studies import beside_paper
from twin.ultrasound.probe_path import WirePath

FEW = {"over": {"conditions": ["lifelike"]}, "seeds": 1, "first_seed": 3}
POSES = choices.read("poses", "paper")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return tmp_path_factory.mktemp("paper")


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch):
    monkeypatch.setattr(study_accuracy, "WORKERS", 1)


def half_the_steps() -> Patterns:
    """The paper's sequence over the board, 32 images instead of 50."""
    code = choices.read_patterns("paper_calibration")
    parts = (part.model_copy(update={"steps": 9}) if isinstance(part, Fringes) else part for part in code.parts)
    return code.model_copy(update={"parts": tuple(parts)})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planes", "sphere"])
def test_ours_keeps_its_bars_where_the_papers_method_is_farther_off(kept, name):
    """Under lifelike conditions; where noise limits a figure, ours is within a fourth of that, the paper's at twice the limit.

    Camera 1, which measures, has its whole size: with a fourth of the pixels the sphere misses that fourth by little. Camera 2
    sees the board alone, and has half the size; fringes over the board have half the steps.
    """
    rig = choices.read_rig(study_accuracy.RIG)
    devices = {"rig": rig.model_copy(update={"cam2": half(rig).cam2}), "board_patterns": half_the_steps()}
    few = FEW | devices | {"poses": POSES | {"count": 6}, "tracing": Tracing(samples=8, room_lux=20)}
    config, done = study_accuracy.study(kept, name, **few)
    compared = beside_paper.compare(config.beside, done)
    assert len(compared) == len(config.beside) and all(one.bar_met for one in compared)
    assert all(one.paper.max() > one.ours.max() for one in compared)
    assert all(one.ours.max() < 1.25 * one.limit for one in compared if one.figure.limit)
    assert len(list((kept / "trials").glob("*.json"))) == 1  # planes and sphere are figures of the same laboratory


@pytest.mark.slow
def test_in_the_tank_ours_is_nearer_to_the_truth_than_the_papers_method(kept, monkeypatch):
    """Three calibrations of the probe with fewer poses than the paper's five, and both cylinders, by a quarter of the slices.

    Cameras have half the size, and few rays a pixel; fringes over the board have half the steps.
    """
    monkeypatch.setattr(probe_accuracy, "CALIBRATIONS", 3)
    monkeypatch.setattr(tube_accuracy, "SLICES", 24)
    monkeypatch.setattr(tank_trial, "CAMERA_HZ", 6.0)
    small = {"rig": half(choices.read_rig(study_accuracy.RIG)), "tracing": Tracing(samples=4, room_lux=20)}
    few = FEW | small | {"poses": POSES | {"count": 9}, "board_patterns": half_the_steps()}
    few |= {"wire_path": WirePath(count=14, roll_deg=ROLL_DEG)}
    (_, (one,)) = study_accuracy.study(kept, "probe", **few)
    figures = one.figures
    for figure in ("cr1_mean", "probe_error", "tube_diameter_error", "cover_diameter_error"):
        assert abs(figures[f"{figure}_ours_mm"]) < abs(figures[f"{figure}_paper_mm"])
    assert figures["cr1_mean_ours_mm"] < 2 * figures["cr1_mean_predicted_mm"]
    assert figures["equation_rms_paper_mm"] > 2 * figures["equation_rms_ours_mm"]
    trials = len(list((kept / "trials").glob("*.json")))
    study_accuracy.study(kept, "cylinders", **few)
    assert len(list((kept / "trials").glob("*.json"))) == trials  # probe and cylinders are figures of the same laboratory
