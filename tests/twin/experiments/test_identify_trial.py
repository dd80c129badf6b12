"""What is identified of a drawn rig is judged by its truth, in its own standard deviations."""

import numpy as np
import pytest

from recon.identification.estimates import Estimate, Findings
from twin.conditions import Conditions, Frames
from twin.experiments import drawn_rig, identify_trial
from twin.ultrasound.transducer import Transducer


def test_errors_are_counted_in_their_sigmas(rig):
    found = Findings(
        {
            "cam1.sensor.saturation_e": Estimate(rig.cam1.sensor.saturation_e + 150, 100.0, "a test"),
            "projector.gamma": Estimate(rig.projector.gamma - 0.3, 0.1, "a test"),
            "conditions.frames.flicker": Estimate(0.012, 0.002, "a test"),
            "room.over_projector": Estimate(0.1, 0.1, "a test"),
        }
    )
    truth = identify_trial.truth_of(rig, Conditions(frames=Frames(flicker=0.01)), Transducer(), found)
    figures = identify_trial.judge(found, truth)
    assert (figures["measured"], figures["held"]) == (3, 2) and figures["held_share"] == pytest.approx(2 / 3)
    assert figures["projector_gamma_over_sigma"] == pytest.approx(-3)
    assert figures["conditions_frames_flicker_over_sigma"] == pytest.approx(1)


def test_the_sheet_holds_nothing_of_what_is_to_be_identified(rig):
    """Two drawn rigs of one size and one kind of pixels have sheets that differ in what images can't show alone."""
    drawn, _ = drawn_rig.draw(rig, 3)
    sheet = identify_trial.sheet_of(drawn)
    for name in ("cam1.lens.f_number", "cam1.sensor.saturation_e", "projector.gamma", "projector.lens.blur_px"):
        assert sheet.number(name) != drawn.number(name)
    assert sheet.cam1.sensor.pixel_um == drawn.cam1.sensor.pixel_um and sheet.cam1.optics == drawn.cam1.optics


@pytest.mark.slow
def test_a_drawn_rig_is_identified_from_its_images(rig, tmp_path, monkeypatch):
    """Of some 60 numbers at least 85 % within their 95 % intervals, all within 6 sigma; the focal lengths to 0.1 %."""
    monkeypatch.setattr(identify_trial, "POSES", 8)
    seed = 51
    drawn, conditions = drawn_rig.draw(rig, seed)
    array = drawn_rig.draw_scanner(np.random.default_rng([seed, 61]))
    drawn = identify_trial.with_scanner(drawn, array)
    found_rig, found = identify_trial.identify_recorded(drawn, conditions, array, tmp_path, seed, seed)
    figures = identify_trial.judge(found, identify_trial.truth_of(drawn, conditions, array, found))
    assert figures["measured"] > 60 and figures["ultrasound_receive_f_number_over_sigma"] and figures["held_share"] >= 0.85
    assert max(abs(value) for name, value in figures.items() if name.endswith("_over_sigma")) < 6
    assert found_rig.cam1.optics.focal_px == pytest.approx(drawn.cam1.optics.focal_px, rel=1e-3)
    assert found_rig.projector.gamma == pytest.approx(drawn.projector.gamma, abs=0.05)
