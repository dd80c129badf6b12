"""Conditions of a session: the same for the same seed, and of the strength that was asked for."""

import numpy as np
import pytest
from pydantic import ValidationError

from recon.model import circle_layout
from recon.model.patterns import Fringes, GrayCode, Patterns
from scenes.catalogue import build_scene
from scenes.kinds import board
from twin.conditions import (
    BoardPrint,
    Conditions,
    Drift,
    Frames,
    Motion,
    Print,
    Skin,
    Sound,
    as_skin,
    check_board,
    draw,
    drifted,
    flexed,
    given,
    printed,
    printed_board,
    speeds,
    triggered,
)

LIFE = Frames(flicker=0.02, stray_dn=1.5, shift=0.03)
MOMENTS = np.array([0, 10, 20, 30, 40])  # ns
FRINGES, CODE = Fringes(pitch=16, steps=8), GrayCode(pitch=16, bits=7)
PATTERNS = Patterns(projector_size=(1280, 800), unwrap="gray", parts=(FRINGES, CODE))


def test_draws_have_their_standard_deviations_and_their_keys():
    """Of 20 000 frames; another seed or pose draws others, the same the same."""
    gain, stray, shift = draw(LIFE, 20_000, 3, 1)
    assert gain.mean() == pytest.approx(1, abs=1e-3)
    assert [gain.std(), stray.std(), shift.std()] == pytest.approx([0.02, 1.5, 0.03], rel=0.02)
    assert all(np.array_equal(a, b) for a, b in zip(draw(LIFE, 9, 3), draw(LIFE, 9, 3), strict=True))
    assert not np.array_equal(draw(LIFE, 9, 3)[0], draw(LIFE, 9, 4)[0])
    assert not np.array_equal(draw(LIFE, 9, 3)[0], draw(LIFE, 9, 3, 1)[0])


@pytest.mark.parametrize("field", ["flicker", "stray_dn", "shift"])
def test_nonsense_is_refused_by_name(field):
    """Negative or huge standard deviations, and unknown keys."""
    for value in (-0.1, 1e3, float("nan")):
        with pytest.raises(ValidationError, match=field):
            Conditions.model_validate({"frames": {field: value}})
    with pytest.raises(ValidationError, match="flickr"):
        Conditions.model_validate({"frames": {"flickr": 0.1}})


def test_prints_are_off_by_their_standard_deviations(rig):
    """Of 4000 targets; lengths have the covariance of circles each off its place, and rims grow as holes shrink."""
    errors = Print(place_mm=0.1, diameter_mm=0.03)
    drawn = [printed(rig.target, errors, seed) for seed in range(4000)]
    lengths = np.array([circle_layout.lengths(target) for target in drawn]) - circle_layout.lengths(rig.target)
    expected = np.sqrt(np.diag(circle_layout.length_covariance(rig.target)))
    assert lengths.std(axis=0) == pytest.approx(expected, rel=0.05)
    wider = np.array([target.outer_diameter_mm for target in drawn]) - rig.target.outer_diameter_mm
    narrower = rig.target.inner_diameter_mm - np.array([target.inner_diameter_mm for target in drawn])
    assert wider.std() == pytest.approx(0.03, rel=0.05) and np.allclose(wider, narrower)
    assert printed(rig.target, errors, 7) == drawn[7] and printed(rig.target, Print(), 7) == rig.target


def test_boards_are_off_by_their_standard_deviations():
    """Of 2000 boards, which bend anew in each pose; the design's own errors stay."""
    design = board.Config(bow_mm=(0.3, 0.0, 0.0), print_error_mm=0.03)
    errors = BoardPrint(place_mm=0.04, stretch=3e-4, diameter_mm=0.02, bow_mm=0.1, flex_mm=0.01)
    drawn = [printed_board(design, errors, seed) for seed in range(2000)]
    bows = np.array([each.bow_mm for each in drawn])
    assert bows.mean(axis=0) == pytest.approx([0.3, 0, 0], abs=0.01) and bows.std(axis=0) == pytest.approx(0.1, rel=0.06)
    assert np.std([each.stretch for each in drawn], axis=0) == pytest.approx(3e-4, rel=0.06)
    assert np.std([each.spread_mm for each in drawn]) == pytest.approx(0.02, rel=0.06)
    assert drawn[0].print_error_mm == pytest.approx(0.05) and len({each.seed for each in drawn}) == 2000
    bent = np.array([flexed(drawn[0], errors, 0, pose).bow_mm for pose in range(2000)]) - bows[0]
    assert bent.std(axis=0) == pytest.approx(0.01, rel=0.06)
    assert printed_board(design, errors, 7) == drawn[7] and flexed(drawn[7], errors, 7, 1) == flexed(drawn[7], errors, 7, 1)


def test_a_board_that_the_worst_draw_would_spoil_is_refused_beforehand():
    """Then none that is drawn is spoiled; of a sound one, each is a board by its own rules."""
    with pytest.raises(ValidationError, match="stretch"):
        check_board(board.Config(stretch=(0.009, 0, 0)), BoardPrint(stretch=0.002))
    sound, errors = board.Config(), BoardPrint(place_mm=0.1, stretch=0.002, diameter_mm=0.1)
    check_board(sound, errors)
    for seed in range(200):
        board.Config.model_validate(printed_board(sound, errors, seed).model_dump())


def test_triggers_brackets_and_speeds_are_off_by_their_standard_deviations():
    """Of 3000 draws; a bracket is as designed in the middle, and ideal conditions change nothing."""
    motion, sound = Motion(trigger_s=1e-4, bracket_mm=0.2, bracket_deg=0.3), Sound(tissue=0.016, water_c=0.5)
    late = triggered(motion, 3000, 1)
    assert late.std(axis=0) == pytest.approx(1e-4, rel=0.06) and abs(np.corrcoef(late.T)[0, 1]) < 0.06
    ends = np.array([given(motion, MOMENTS, seed)[[0, 2, 4]] for seed in range(3000)])
    assert (ends[:, 2] - ends[:, 0]).std(axis=0) == pytest.approx([np.deg2rad(0.3)] * 3 + [0.2] * 3, rel=0.06)
    assert (ends[:, 1] == 0).all()
    drawn = np.array([speeds(sound, seed) for seed in range(3000)])
    assert drawn.mean(axis=0) == pytest.approx([1, 0], abs=0.03) and drawn.std(axis=0) == pytest.approx([0.016, 0.5], rel=0.06)
    assert not triggered(Motion(), 5, 1).any() and not given(Motion(), MOMENTS, 1).any() and speeds(Sound(), 1) == (1, 0)


def test_devices_drift_by_their_standard_deviations(rig):
    """Of 2000 rigs: each principal point and focal length by itself, both axes of a lens alike; nothing else."""
    errors = Drift(centre_px=0.1, focal=3e-5)
    drawn = [drifted(rig, errors, seed) for seed in range(2000)]
    for name in ("cam1", "cam2", "projector"):
        before, after = getattr(rig, name), [getattr(one, name) for one in drawn]
        centres = np.array([one.optics.centre_px for one in after]) - before.optics.centre_px
        assert centres.std(axis=0) == pytest.approx(0.1, rel=0.06)
        longer = np.array([one.optics.focal_px for one in after]) / before.optics.focal_px - 1
        assert longer.std(axis=0) == pytest.approx(3e-5, rel=0.06) and np.allclose(longer[:, 0], longer[:, 1])
        back = after[0].optics.model_copy(update={key: getattr(before.optics, key) for key in ("centre_px", "focal_px")})
        assert after[0].model_copy(update={"optics": back}) == before
    assert drifted(rig, errors, 7) == drawn[7] and drifted(rig, Drift(), 7) is rig


def test_ideal_boards_are_as_designed():
    design = board.Config(bow_mm=(0.3, 0.0, 0.0), seed=5)
    assert printed_board(design, BoardPrint(), 7) is design and flexed(design, BoardPrint(), 7, 2) is design


def test_skin_lets_light_spread_and_is_wet_in_patches():
    """Of the phantom alone: the share that was asked for, in few patches, the same for the same seed; ideal skin is as built."""
    scene = build_scene({"kind": "breast", "edge_mm": 3.0})
    skin = Skin(spread_mm=0.4, wet=0.2, patch_mm=25)
    breast, *others = as_skin(scene, skin, 5).things
    assert breast.material.spread_mm == 0.4 and breast.wet is not None
    assert breast.wet.mean() == pytest.approx(0.2, abs=0.02)
    mesh = breast.mesh
    shore = np.abs(np.diff(breast.wet[mesh.edges_unique] > 0.5, axis=1)).mean()  # of edges; 0.32 without patches
    assert 0.002 < shore < 0.1
    assert all(thing.material.spread_mm == 0 and thing.wet is None for thing in others)
    np.testing.assert_array_equal(as_skin(scene, skin, 5).things[0].wet, breast.wet)
    assert (as_skin(scene, skin, 6).things[0].wet != breast.wet).any()
    assert as_skin(scene, Skin(), 5) is scene
