"""Rigs drawn at random are rigs, all look at the same place, and depend on the seed alone."""

import numpy as np

from recon.model.rig import Rig
from twin.experiments import drawn_rig
from twin.ultrasound.transducer import Transducer


def test_drawn_rigs_are_whole_and_see_the_working_volume(rig):
    """From 0.3 MP to the rig's own; the middle of the volume lies within all images."""
    sizes = set()
    for seed in range(30):
        drawn, conditions = drawn_rig.draw(rig, seed)
        again, _ = drawn_rig.draw(rig, seed)
        assert drawn == again == Rig.model_validate(drawn.model_dump(mode="json"))
        for device in (drawn.cam1, drawn.cam2, drawn.projector):
            camera = device.optics.camera()
            pixels = camera.project([[0, 0, 660], [60, 0, 660], [0, -50, 660]])
            assert (pixels > 0).all() and (pixels < camera.size).all()
        assert drawn.cam1.optics.size == drawn.cam2.optics.size and 0 < conditions.frames.flicker < 0.02
        sizes.add(drawn.cam1.optics.size)
    assert sizes == set(drawn_rig.CAMERA_SIZES)


def test_seeds_draw_other_rigs(rig):
    gammas = [drawn_rig.draw(rig, seed)[0].projector.gamma for seed in range(20)]
    assert len(set(gammas)) == 20 and np.ptp(gammas) > 0.8


def test_drawn_scanners_are_scanners():
    """Of 4 to 12 MHz, with rows of half a wavelength at most."""
    drawn = [drawn_rig.draw_scanner(np.random.default_rng([seed, 61])) for seed in range(30)]
    frequencies = [array.frequency_mhz for array in drawn]
    assert min(frequencies) < 5 and max(frequencies) > 11 and len(set(frequencies)) == 30
    for array in drawn:
        assert array == Transducer.model_validate(array.model_dump(mode="json"))
        assert array.scale_mm_per_px[1] < 0.5001 * array.wavelength_mm
