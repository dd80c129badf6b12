"""A layout's devices stand where its lengths say, and look at the same place."""

import numpy as np
import pytest

from recon.model import circle_layout
from twin.experiments.layout import AIM_MM, Layout, laid_out, least_turn

DEVICES = {"projector": "projector_mm", "cam2": "camera_mm"}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("distance", [60.0, 165.0, 300.0])
def test_a_device_is_at_its_distance_and_sees_the_aim_in_the_middle(rig, device, distance):
    """On the line that it stood on; camera 1, whose frame the world is, and all other devices stay."""
    before = getattr(rig, device).optics.camera()
    middle = (np.array(before.size) - 1) / 2
    ray = before.rays(middle)
    aim = before.centre + ray * (AIM_MM - before.centre[2]) / ray[2]
    changed = laid_out(rig, Layout(**{DEVICES[device]: distance}))
    after = getattr(changed, device).optics.camera()
    assert np.linalg.norm(after.centre) == pytest.approx(distance, abs=1e-6)
    assert np.cross(after.centre, before.centre) == pytest.approx(0, abs=1e-6 * distance) and after.centre @ before.centre > 0
    assert after.project(aim) == pytest.approx(middle, abs=1e-3)
    assert changed.model_copy(update={device: getattr(rig, device)}) == rig
    kept = {"device_from_world": getattr(rig, device).optics.device_from_world}
    assert getattr(changed, device).optics.model_copy(update=kept) == getattr(rig, device).optics


def test_a_device_does_not_roll(rig):
    """Its turn is about an axis at right angles to both of its directions of view: the smallest there is."""
    before, after = (one.projector.optics.camera() for one in (rig, laid_out(rig, Layout(projector_mm=60.0))))
    turn = after.camera_from_world[:3, :3].T @ before.camera_from_world[:3, :3]
    ray = before.rays((np.array(before.size) - 1) / 2)
    angle = np.arccos((np.trace(turn) - 1) / 2)
    assert angle == pytest.approx(np.arccos(ray @ turn @ ray), abs=1e-6) and angle > 0.1


def test_a_rig_stays_as_described_where_nothing_is_given(rig):
    assert laid_out(rig, Layout()) == rig


def test_the_distance_that_it_has_changes_no_pixel(rig):
    """165 mm is rounded in the file; a pixel's thousandth is all that the same distance moves."""
    before = rig.projector.optics.camera()
    after = laid_out(rig, Layout(projector_mm=float(np.linalg.norm(before.centre)))).projector.optics.camera()
    points = np.array([[-60.0, -50, 620], [70, 40, 700], [0, 0, 660]])
    assert after.project(points) == pytest.approx(before.project(points), abs=1e-6)


def test_all_lengths_of_a_target_grow_alike(rig):
    rig = rig.model_copy(update={"target": rig.target.model_copy(update={"c2_aside_mm": 1.5})})
    target = laid_out(rig, Layout(target_scale=1.4)).target
    assert circle_layout.circle_centres(target) == pytest.approx(1.4 * circle_layout.circle_centres(rig.target))
    for name in ("outer_diameter_mm", "inner_diameter_mm"):
        assert getattr(target, name) == pytest.approx(1.4 * getattr(rig.target, name))
    assert target.board_mm == pytest.approx(1.4 * np.array(rig.target.board_mm))
    assert target.tolerance_mm == rig.target.tolerance_mm  # a printer's, whatever it prints


def test_the_least_turn_brings_one_direction_to_another(rng):
    """Of any two directions; of one that is itself no turn."""
    for first, second in rng.standard_normal((20, 2, 3)):
        turn = least_turn(first, second)
        assert turn @ first / np.linalg.norm(first) == pytest.approx(second / np.linalg.norm(second))
        assert turn @ np.cross(first, second) == pytest.approx(np.cross(first, second)) and np.linalg.det(turn) > 0
    assert (least_turn(first, 3 * first) - np.eye(3)) == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize("field", ["projector_mm", "camera_mm", "target_scale"])
@pytest.mark.parametrize("value", [0.0, -5.0, float("nan")])
def test_lengths_are_positive(field, value):
    with pytest.raises(ValueError, match=field):
        Layout(**{field: value})
