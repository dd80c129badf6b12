"""Truth of a view against closed forms."""

import numpy as np
import pytest

from recon.geometry.camera import Camera
from recon.model.circle_layout import circle_centres
from tests.twin.tracking.takes import facing, rig
from twin.tracking.samples import Motion
from twin.tracking.target_truth import disc_masks, ellipse_rows, inside_share, outline, path_length

RIG = rig()
PINHOLE = Camera((1280, 1024), np.array([[3320.0, 0, 640], [0, 3320, 512], [0, 0, 1]]), np.zeros(0))


def test_an_outline_is_the_conic_that_the_circle_projects_to():
    """C' = H^-T C H^-1 for the homography H of the circle's plane."""
    pose, radius = facing(40), 9.0
    rim = PINHOLE.project((np.append(outline(np.zeros((1, 3)), radius)[0], np.ones((64, 1)), axis=1) @ pose.T)[:, :3])
    row = ellipse_rows(rim[None])[0]
    homography = PINHOLE.matrix @ pose[:3][:, [0, 1, 3]]
    inverse = np.linalg.inv(homography)
    conic = inverse.T @ np.diag([1, 1, -(radius**2)]) @ inverse
    centre = np.linalg.solve(conic[:2, :2], -conic[:2, 2])
    assert row[:2] == pytest.approx(centre, abs=1e-6)
    values = np.linalg.eigvalsh(conic[:2, :2] / -(conic[2, 2] + conic[2, :2] @ centre))
    assert row[2:4] == pytest.approx(1 / np.sqrt(np.sort(values)), abs=1e-6)
    along = np.array([np.cos(row[4]), np.sin(row[4])])
    assert np.linalg.norm(conic[:2, :2] @ along / np.linalg.norm(conic[:2, :2] @ along)) == pytest.approx(1)
    assert abs(np.cross(np.append(along, 0), np.append(conic[:2, :2] @ along, 0))[2]) < 1e-6 * np.abs(conic[:2, :2]).max()


@pytest.mark.parametrize(
    ("middle", "share"),
    [((640.0, 512.0), 1.0), ((-0.5, 512.0), 0.5), ((1279.5, 1023.5), 0.25), ((-60.0, 512.0), 0.0), ((640.0, 1023.5), 0.5)],
)
def test_how_much_of_a_disc_lies_in_the_image(middle, share):
    assert inside_share(np.array([[*middle, 50.0, 30.0, 0.0]]), (1280, 1024))[0] == pytest.approx(share, abs=0.01)


def test_a_turned_ellipse_reaches_as_far_as_its_axis(rng):
    """Against a count of pixels."""
    row = np.array([10.0, 300.0, 60.0, 25.0, 0.7])
    mask = disc_masks(row[None], np.array([[-100, 200]]), 200)[0] > 0
    assert mask.sum() == pytest.approx(np.pi * 60 * 25, rel=0.01)
    assert inside_share(row[None], (1280, 1024))[0] == pytest.approx(mask[:, 100:].sum() / mask.sum(), abs=0.01)


def test_paths_are_as_long_as_the_shift_asks_for():
    pose = facing(0, (0, 0, 664.0))
    shift = np.array([2.0, 0, 0])
    model = circle_centres(RIG.target)
    assert path_length(Motion(pose, shift, np.zeros(3)), PINHOLE, model) == pytest.approx(3320 * 2 / 664, rel=1e-6)
    spin = Motion(pose, np.zeros(3), 0.2 * pose[:3, 2])
    assert path_length(spin, PINHOLE, model) == pytest.approx(
        3320 / 664 * 0.2 * np.linalg.norm(model, axis=1), rel=0.01, abs=1e-9
    )
