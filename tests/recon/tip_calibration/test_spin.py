"""The direction of a shaft, from a film in which it turns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon.errors import InputError
from recon.geometry import rigid
from recon.tip_calibration import spin
from recon.tip_calibration.pivot import Frames
from tests.recon.tip_calibration import pivot_films
from tests.recon.tip_calibration.test_pivot import frames_of


def spun(rng, turn_deg=150.0, wobble_deg=0.0, slide_mm=0.0) -> tuple[pivot_films.Tool, Frames]:
    """A tool that turns about its shaft, its tip in a dimple or sliding along the shaft."""
    tool = pivot_films.draw_tool(rng)
    upright = Rotation.align_vectors([-pivot_films.UP], [tool.axis])[0]
    turned = Rotation.from_rotvec(np.radians(np.linspace(0, turn_deg, 200))[:, None] * -pivot_films.UP)
    wobble = Rotation.from_rotvec(np.radians(wobble_deg) * rng.standard_normal((200, 3)))
    dimples = pivot_films.DIMPLE + np.linspace(0, slide_mm, 200)[:, None] * -pivot_films.UP
    poses = pivot_films.poses_of((wobble * turned * upright).as_matrix(), tool.tip, dimples)
    return tool, frames_of(pivot_films.tracked(poses, rng))


def test_errors_are_as_predicted(rng):
    """Of 40 films: two numbers of the axis, in standard deviations, are chi-square (4 sigma of their mean)."""
    squares = []
    for k in range(40):
        tool, frames = spun(rng, wobble_deg=0.1 * (k % 2))
        found = spin.calibrate(frames, "film", tool.axis)
        across = np.linalg.svd(found.axis[None])[2][1:]
        error = across @ (tool.axis - found.axis)
        squares.append(error @ np.linalg.solve(across @ found.covariance @ across.T, error))
        assert np.degrees(np.arccos(min(1.0, found.axis @ tool.axis))) < 0.1
    assert abs(np.mean(squares) - 2) < 4 * np.sqrt(2 * 2 / 40) and np.mean(np.array(squares) < chi2.isf(0.05, 2)) > 0.84


def test_wrong_poses_are_left_out(rng):
    tool, frames = spun(rng)
    poses = frames.poses.copy()
    poses[:20] = rigid.moved(poses[:20], [0.1, 0.05, 0.2, 0, 0, 0])
    found = spin.calibrate(frames._replace(poses=poses), "film", tool.axis)
    assert not found.used[:20].any() and np.degrees(np.linalg.norm(found.axis - tool.axis)) < 0.05


def test_a_bent_tip_lies_beside_the_line(rng):
    """The tip of a needle that slides and turns: on the line by 0.05 mm; bent by 1.5 mm, as far from it."""
    tool, frames = spun(rng, slide_mm=5.0)
    found = spin.calibrate(frames, "film", tool.axis)
    assert spin.beside(frames, found.axis, tool.tip) < 0.05
    aside = np.linalg.svd(tool.axis[None])[2][1]
    assert spin.beside(frames, found.axis, tool.tip + 1.5 * aside) == pytest.approx(1.5, abs=0.05)


def test_what_gives_no_axis_is_refused(rng):
    tool, little = spun(rng, turn_deg=40.0)
    with pytest.raises(InputError, match=r"film: expected a tool that turns about its shaft by 60 deg or more, found 40"):
        spin.calibrate(little, "film", tool.axis)
    _, waved = spun(rng, wobble_deg=3.0)
    with pytest.raises(InputError, match=r"keeps its direction to 1 deg .* found 3\.. deg: lay it into a groove"):
        spin.calibrate(waved, "film", tool.axis)
