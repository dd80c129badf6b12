"""Where a rig works follows from the rig: that of the paper is as published, one half as large works at half the depths."""

import numpy as np
import pytest

from recon.model.patterns import Patterns
from scenes.board_poses import Config as Poses
from scenes.board_poses import random_poses
from scenes.kinds import board, plane
from sonotwin import choices
from twin.experiments import drawn_session
from twin.experiments.drawn_session import Noise
from twin.optics.surface_session import calibration_of
from twin.working_range import PAPER, working_range


def shrunk(rig, factor):
    """A rig of the same devices at other distances: baselines and focus shorter."""
    changed = {}
    for name in ("cam1", "cam2", "projector"):
        device = getattr(rig, name)
        pose = device.optics.device_from_world
        near = tuple(factor * length for length in pose.translation_mm)
        optics = device.optics.model_copy(update={"device_from_world": pose.model_copy(update={"translation_mm": near})})
        aperture = {"focus_mm": factor * device.lens.focus_mm, "f_number": factor * device.lens.f_number}
        changed[name] = device.model_copy(update={"optics": optics, "lens": device.lens.model_copy(update=aperture)})
    return rig.model_copy(update=changed)


def test_the_papers_rig_works_where_the_paper_says():
    assert working_range(choices.read_rig()) == PAPER and PAPER.depths_mm == (606, 713)
    limits, design = Poses(), board.Config()
    assert PAPER.poses(limits).depth_mm == (606, 713) and PAPER.board(design) is design
    assert [PAPER.plate(pose) for pose in plane.PAPER_POSES] == list(plane.PAPER_POSES)
    assert Noise().at(PAPER) == Noise(of_paper=False)


@pytest.mark.parametrize("factor", [0.5, 0.76, 1.5])
def test_a_rig_of_another_size_works_at_other_depths(factor):
    """Lenses of the same cone of light at all distances make depths, breadths and places proportional; 1 % of a step of depth."""
    rig = shrunk(choices.read_rig(), factor)
    found = working_range(rig)
    assert found.scale == pytest.approx(factor, rel=0.01) and found.breadth == pytest.approx(factor, rel=0.02)
    assert found.magnification == pytest.approx(1 / factor, rel=0.02) and max(map(abs, found.aside_mm)) <= 3
    assert found.depths_mm == pytest.approx((606 * factor, 713 * factor), rel=0.01)
    design = board.design(found.board(board.Config()))
    poses = random_poses(found.poses(Poses(count=6)), design, list(calibration_of(rig).cameras.values()))
    middles = poses[:, 2, 3]
    assert middles.min() > 500 * factor and middles.max() < 820 * factor
    images, _ = drawn_session.led(rig, Noise(), np.random.default_rng(1), found.place(*drawn_session.MIDDLE_MM))
    assert images[:, 2, 3].mean() == pytest.approx(620 * factor, rel=0.02)
    given = board.Config(spacing_mm=7.0, diameter_mm=4.0)
    assert found.board(given) is given, "a board that is given stays"
    assert found.poses(Poses(depth_mm=(300, 400))).depth_mm == (300, 400)


@pytest.mark.parametrize(("factor", "margin"), [(0.06, 0.01), (12.0, 0.15)])
def test_depths_are_those_of_rigs_of_any_size(factor, margin):
    """Centimetres or metres away, no depth is a fixed one; far lenses are sharp all over, so that where all views meet counts."""
    assert working_range(shrunk(choices.read_rig(), factor)).scale == pytest.approx(factor, rel=margin)


def test_noisier_cameras_make_detectors_noisier():
    rig = choices.read_rig()
    sensor = rig.cam1.sensor.model_copy(update={"saturation_e": rig.cam1.sensor.saturation_e / 4})
    noisy = rig.model_copy(update={name: getattr(rig, name).model_copy(update={"sensor": sensor}) for name in ("cam1", "cam2")})
    found = working_range(noisy)
    assert 1.9 < found.noise < 3, "four times fewer electrons: twice the shot noise, and the dark noise counts more"
    level = Noise().at(found)
    assert level.column_px == pytest.approx(0.02 * found.noise) and level.board_px == pytest.approx(0.004 * found.noise)
    assert Noise(of_paper=False).at(found).board_px == 0.004


@pytest.mark.parametrize("size", [(1920, 1080), (912, 1140), (640, 361)])
@pytest.mark.parametrize("name", ["paper_surface", "paper_calibration", "gray_surface", "multi_frequency", "gray_alone"])
def test_patterns_of_another_raster_encode_all_of_it(name, size):
    before = choices.read_patterns(name)
    after = before.on(size)
    assert after.projector_size == size and after.axes == before.axes and before.on(before.projector_size) is before
    assert [part.kind for part in after.parts] == [part.kind for part in before.parts]
    assert Patterns.model_validate(after.model_dump()) == after and after.images().shape[1:] == size[::-1]
    pitches = [(old.pitch, new.pitch) for old, new in zip(before.parts, after.parts, strict=True) if hasattr(old, "pitch")]
    assert all(new == old or new >= size[0] for old, new in pitches)
