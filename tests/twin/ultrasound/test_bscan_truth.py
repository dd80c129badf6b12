"""Truth: sections and masks."""

import numpy as np
import pytest

from recon.geometry import rigid
from scenes.catalogue import build_scene
from tests.twin.ultrasound import plain_sound
from tests.twin.ultrasound.phantoms import down
from twin.ultrasound import bscan_truth
from twin.ultrasound.echo_solids import body
from twin.ultrasound.sound_paths import follow


@pytest.fixture(scope="module")
def cylinder():
    return body(build_scene({"kind": "inner_cylinder"}))


def test_the_section_of_the_cylinder_is_its_circle(cylinder, small):
    pose = down(small, (4.0, -2.0, 650.0)) @ np.diag([1.0, 1, 1, 1])
    turned = pose.copy()
    turned[:3, 0], turned[:3, 2] = pose[:3, 2], -pose[:3, 0]
    turned[:3, 3] = np.array([4.0, -2.0, 650.0]) - small.width_mm / 2 * turned[:3, 0]
    (outline,) = bscan_truth.sections(cylinder, turned)["inner"]
    radius = np.linalg.norm(outline - [small.width_mm / 2, 20.0], axis=1)
    assert np.abs(radius - 7.91).max() < 0.002
    assert (outline[0] == outline[-1]).all()


def test_a_mask_is_as_wide_as_its_object_and_too_deep(cylinder, clean):
    """Lines stand where they are; water stretches depths by 1540/1488 and the cylinder, 2700 m/s, shrinks to 57 % within."""
    array = np.array([0.0, 1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([array, [0, 0, 1], np.cross(array, [0, 0, 1])])
    pose[:3, 3] = np.array([4.0, -2.0, 650.0]) - clean.width_mm / 2 * array
    straight = clean.model_copy(update={"refraction": False})
    shown = bscan_truth.labels(follow(cylinder, straight, pose), straight)
    names = [one.name for one in cylinder.solids]
    mask = bscan_truth.masks(shown, len(names))[names.index("inner")]
    assert mask.any(axis=0).sum() * clean.scale_mm_per_px[0] == pytest.approx(15.82, abs=0.25)
    rows = np.flatnonzero(mask[:, 160]) * clean.scale_mm_per_px[1]
    top = (20 - 7.91) * 1540 / 1488.3
    assert rows[0] == pytest.approx(top, abs=0.25)
    assert rows[-1] == pytest.approx(top + 15.82 * 1540 / 2700, abs=0.3)


def test_labels_are_shown_as_by_the_slow_way(cylinder, clean):
    """Along the rod, turned a little, so that lines bend."""
    pose = down(clean, (4.0, -2.0, 650.0)) @ rigid.from_rotation_vector([0.05, 0.2, 0.1], [0, 0, 0])
    paths = follow(cylinder, clean, pose)
    slow = plain_sound.shown_labels(paths, clean)
    assert len(np.unique(slow)) > 1
    assert np.abs(paths.shift_mm).max() > clean.scale_mm_per_px[0]
    assert (bscan_truth.labels(paths, clean) == slow).all()


def test_wires_are_points_where_they_cross_the_plane(small):
    made = body(build_scene({"kind": "crosswire"}))
    found = bscan_truth.sections(made, down(small, (4.0, -2.0, 640.0)))
    assert found["wire0"][0] == pytest.approx(np.array([[small.width_mm / 2, 19.9]]), abs=1e-6)
    assert found["wire1"][0] == pytest.approx(np.array([[small.width_mm / 2, 20.1]]), abs=1e-6)


def test_echo_free_is_free_of_echoes(cylinder, small):
    """Water is black, and nothing is grainy."""
    pose = down(small, (4.0, -2.0, 650.0))
    image = bscan_truth.echo_free(bscan_truth.labels(follow(cylinder, small, pose), small), cylinder, small)
    assert (image == 0).all()
