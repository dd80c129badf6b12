"""What is identified of a drawn rig is judged by its truth, in its own standard deviations."""

import numpy as np
import pytest

from recon.identification.estimates import Estimate, Findings
from twin.conditions import Conditions, Frames
from twin.experiments import drawn_rig, identify_trial
from twin.optics.instruments import transmission
from twin.optics.light_transport import Tracing
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


def test_a_richer_distortion_has_terms_that_the_rig_lacks(rig):
    found = Findings({f"cam1.optics.distortion.{k}": Estimate(0.01, 0.02, "a test") for k in (0, 7)})
    truth = identify_trial.truth_of(rig, Conditions(), Transducer(), found)
    assert truth == {"cam1.optics.distortion.0": rig.cam1.optics.distortion[0], "cam1.optics.distortion.7": 0.0}


def test_the_middle_of_an_image_sees_what_it_saw_in_the_whole(rig, rng):
    """Places in the image, and the light that the lens lets pass."""
    drawn, _ = drawn_rig.draw(rig, 3)
    small = identify_trial.middle_of(drawn)
    whole, part = drawn.cam1.optics.camera(), small.cam1.optics.camera()
    points = whole.rays(rng.uniform(300, 400, (20, 2))) * 660
    cut = (np.array(whole.size) - part.size) / 2
    assert tuple(part.size) == identify_trial.MIDDLE_PX
    assert part.project(points) == pytest.approx(whole.project(points) - cut, abs=1e-6)
    u, v = cut.astype(int)
    passed = (transmission(device.optics.camera(), device.lens) for device in (drawn.cam1, small.cam1))
    full, middle = passed
    assert middle == pytest.approx(full[v : v + part.size[1], u : u + part.size[0]], rel=1e-5)


def test_settings_are_ranked_by_the_twin_of_the_rig_itself(rig, monkeypatch):
    """Within 8 %, by few points and samples; a sheet that doesn't know the blur takes the fine fringes for better."""
    monkeypatch.setattr(identify_trial, "MIDDLE_PX", (96, 80))
    monkeypatch.setattr(identify_trial, "FINE_TRACING", Tracing(samples=128, room_lux=20))
    drawn, conditions = drawn_rig.draw(rig, 0)
    found = identify_trial.choose_setting(drawn, drawn, conditions, 0, conditions.frames)
    assert [found[f"{name}_predicted_over_found"] for name in identify_trial.SETTINGS] == pytest.approx([1, 1, 1], abs=0.08)
    assert (found["ranked"], found["ranked_by_sheet"]) == (1, 0)
    assert found["designed_found_mm"] < found["half_light_found_mm"] < found["fine_third_light_found_mm"]


def test_the_sheet_holds_nothing_of_what_is_to_be_identified(rig):
    """Two drawn rigs of one size and one kind of pixels have sheets that differ in what images can't show alone."""
    drawn, _ = drawn_rig.draw(rig, 3)
    sheet = identify_trial.sheet_of(drawn)
    for name in ("cam1.lens.f_number", "cam1.sensor.saturation_e", "projector.gamma", "projector.lens.blur_px"):
        assert sheet.number(name) != drawn.number(name)
    assert sheet.cam1.sensor.pixel_um == drawn.cam1.sensor.pixel_um and sheet.cam1.optics == drawn.cam1.optics


@pytest.mark.slow
def test_a_drawn_rig_is_identified_from_its_images(rig, tmp_path, monkeypatch):
    """Of some 60 numbers at least 85 % within their 95 % intervals, all within 6 sigma; the focal lengths to 0.1 %.

    Fewer poses, rays, frames and B-scans than in the study.
    """
    scene, path, clocks = identify_trial.SWEEPS["tissue"]
    monkeypatch.setitem(identify_trial.SWEEPS, "tissue", (scene, path.model_copy(update={"speed_mm_s": 40.0}), clocks))
    few = Tracing(samples=16, room_lux=20)
    fewer = {"POSES": 6, "FRAMES": 10, "FRINGES_TRACING": {"cam1": identify_trial.TRACING, "cam2": few}, "TRACING": few}
    for name, value in fewer.items():
        monkeypatch.setattr(identify_trial, name, value)
    seed = 51
    drawn, conditions = drawn_rig.draw(rig, seed)
    array = drawn_rig.draw_scanner(np.random.default_rng([seed, 61]))
    drawn = identify_trial.with_scanner(drawn, array)
    found_rig, found = identify_trial.identify_recorded(drawn, conditions, array, tmp_path, seed, seed)[:2]
    figures = identify_trial.judge(found, identify_trial.truth_of(drawn, conditions, array, found))
    assert figures["measured"] > 60 and figures["ultrasound_receive_f_number_over_sigma"] and figures["held_share"] >= 0.85
    assert max(abs(value) for name, value in figures.items() if name.endswith("_over_sigma")) < 6
    assert found_rig.cam1.optics.focal_px == pytest.approx(drawn.cam1.optics.focal_px, rel=1e-3)
    assert found_rig.projector.gamma == pytest.approx(drawn.projector.gamma, abs=0.05)
