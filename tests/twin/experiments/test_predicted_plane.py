"""What is predicted of a plane is what is found on a rendered one, and depends on the rig as theory has it."""

import numpy as np
import pytest

from recon.identification import rig_file
from recon.identification.estimates import Estimate, Findings
from recon.model.patterns import Fringes, GrayCode, Patterns
from scenes.kinds import plane
from twin.experiments import drawn_rig, predicted_plane, surface_accuracy
from twin.experiments.predicted_plane import Measurement
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting


def measurement(rig, **fields) -> Measurement:
    parts = (Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=8, complementary=True))
    patterns = Patterns(projector_size=rig.projector.optics.size, unwrap="gray", parts=parts)
    usual = {"plate": plane.PAPER_POSES[2], "shooting": Shooting(), "tracing": Tracing(samples=1024, room_lux=20)}
    return Measurement(patterns, **usual | fields)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [201, 202])
def test_a_rendered_plane_is_as_far_off_as_is_predicted(rig, seed):
    """Of rigs drawn at random, within 5 %, and so are exposures, which are set for the brightest places.

    By many samples: of a coarse raster, nearly in focus, 16 leave 0.05 projector px of noise of their own, 64 half of it.
    """
    drawn, _ = drawn_rig.draw(rig, seed)
    chosen = measurement(drawn)
    found = surface_accuracy.experiment(drawn, plane.build(chosen.plate), chosen.patterns, seed, chosen.tracing)
    predicted = predicted_plane.predict(drawn, chosen)
    assert predicted.rms_mm == pytest.approx(found.metrics["plane_plate_rms_mm"], rel=0.05)
    assert predicted.exposure_s == pytest.approx(found.view.exposure.time_s, rel=0.05)


def test_shot_noise_falls_with_the_root_of_the_light(rig):
    """Of sensors without dark noise, in images of 12 bits: fourfold for half the error. Longer ones that saturate are refused."""
    sensor = rig.cam1.sensor.model_copy(update={"dark_noise_e": 0.0, "dark_current_e_per_s": 0.0, "adc_bits": 12})
    quiet = rig.model_copy(update={"cam1": rig.cam1.model_copy(update={"sensor": sensor})})
    dark = Tracing(samples=16, room_lux=0)
    shots = [Shooting(exposure_s=seconds, bits=12) for seconds in (0.001, 0.004)]
    short, long = (predicted_plane.predict(quiet, measurement(rig, tracing=dark, shooting=shot)) for shot in shots)
    assert short.noise_mm / long.noise_mm == pytest.approx(2, rel=0.02)
    with pytest.raises(ValueError, match="bright places saturate"):
        predicted_plane.predict(quiet, measurement(rig, shooting=Shooting(exposure_s=0.1, bits=12)))
    assert long.modulation_dn / short.modulation_dn == pytest.approx(4, rel=1e-6)


def test_elasticities_are_those_of_larger_changes(rig):
    """By a tenth up and down; the depth of focus, at the plane, changes nothing to first order."""
    names = ["cam1.sensor.saturation_e", "projector.gamma", "projector.lens.blur_px"]
    found = predicted_plane.elasticities(rig, measurement(rig), names)
    assert list(found) == sorted(names, key=lambda name: -abs(found[name])) and found[names[0]] == pytest.approx(-0.5, abs=0.05)
    for name, slope in found.items():
        ends = [
            predicted_plane.predict(
                rig_file.apply(rig, Findings({name: Estimate(rig.number(name) * share, 0.0, "a test")})), measurement(rig)
            ).rms_mm
            for share in (0.9, 1.1)
        ]
        assert slope == pytest.approx(np.log(ends[1] / ends[0]) / np.log(1.1 / 0.9), abs=0.01)


def test_the_interval_is_that_of_the_measured_numbers(rig):
    """5 % of the saturation, which the error goes with by -0.5, and half as much again in quadrature of another like it."""
    number = rig.cam1.sensor.saturation_e
    one = rig_file.apply(rig, Findings({"cam1.sensor.saturation_e": Estimate(number, 0.05 * number, "a test")}))
    now = predicted_plane.predict(rig, measurement(rig)).rms_mm
    assert predicted_plane.uncertainty(rig, measurement(rig)) == 0
    assert predicted_plane.uncertainty(one, measurement(rig)) == pytest.approx(0.025 * now, rel=0.1)


def test_a_plate_out_of_view_is_refused(rig):
    with pytest.raises(ValueError, match="in view of camera 1 and the projector"):
        predicted_plane.predict(rig, measurement(rig, plate=plane.Config(centre_mm=(2000.0, 0.0, 660.0))))
