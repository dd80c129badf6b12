"""A tip is found as exactly as is predicted, whatever the tool, and wrong poses don't pull it."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from recon.estimation.equations import Undetermined
from recon.geometry import rigid
from recon.tip_calibration import pivot
from recon.tip_calibration.pivot import TIP, Frames
from tests.recon.tip_calibration import pivot_films


def film(rng, **how) -> tuple[pivot_films.Tool, Frames]:
    tool = pivot_films.draw_tool(rng)
    return tool, frames_of(pivot_films.tracked(pivot_films.poses_of(pivot_films.turns(tool, rng, **how), tool.tip), rng))


def frames_of(track) -> Frames:
    return Frames(track.poses, track.covariance, track.shared)


def test_errors_are_as_predicted(rng):
    """Of 20 films: the errors' squares, in standard deviations, are chi-square (4 sigma of their mean), and all within 0.1 mm."""
    squares, lengths = [], []
    for _ in range(20):
        tool, frames = film(rng)
        found = pivot.calibrate(frames)
        error = np.concatenate([found.tip - tool.tip, found.dimple - pivot_films.DIMPLE])
        squares.append(error @ np.linalg.solve(found.covariance, error))
        lengths.append(np.linalg.norm(error[TIP]))
    assert np.max(lengths) < 0.1
    assert abs(np.mean(squares) - 6) < 4 * np.sqrt(2 * 6 / 20)
    assert np.mean(np.array(squares) < chi2.isf(0.05, 6)) > 0.8, "0.95 less 3 sigma"


def test_exact_poses_give_the_exact_tip(rng):
    tool = pivot_films.draw_tool(rng)
    poses = pivot_films.poses_of(pivot_films.turns(tool, rng), tool.tip)
    found = pivot.calibrate(Frames(poses, *np.zeros((2, 200, 6, 6))))
    np.testing.assert_allclose([found.tip, found.dimple], [tool.tip, pivot_films.DIMPLE], atol=1e-9)


def test_it_is_the_least_squares_of_the_poses_errors(rng):
    """SciPy finds the same with each pose's six errors, and those shared, as unknowns of their own."""
    _, frames = film(rng, count=12)
    found = pivot.fit(frames, pivot.start(frames), 0.02)
    roots, shared = np.linalg.cholesky(frames.covariance), pivot.symmetric_root(frames.shared)

    def errors(unknowns):
        place, alike, own = unknowns[:6], unknowns[6:12], unknowns[12:].reshape(12, 6)
        right = rigid.moved(frames.poses, -np.einsum("nij,nj->ni", roots, own))
        left = right[:, :3, :3] @ place[:3] + right[:, :3, 3] - place[3:]
        left += np.einsum("nij,j->ni", rigid.slopes(right[:, :3, :3] @ place[:3]) @ shared, alike)
        return np.concatenate([(left / 0.02).ravel(), alike, own.ravel()])

    begin = np.concatenate([found + 0.05, np.zeros(72)])
    whole = least_squares(errors, begin, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14).x[:6]
    np.testing.assert_allclose(found[:6], whole, atol=2e-4)


def test_wrong_poses_are_left_out_by_name(rng):
    """Of 200 poses 30 are off by some mm or degrees; those are left out, and few others by chance (1 of 1000)."""
    tool, frames = film(rng)
    wrong = rng.choice(200, 30, replace=False)
    off = rng.standard_normal((30, 6)) * [0.1, 0.1, 0.1, 8, 8, 8]
    poses = frames.poses.copy()
    poses[wrong] = rigid.moved(poses[wrong], off)
    found = pivot.calibrate(frames._replace(poses=poses))
    assert not found.used[wrong].any() and (~found.used).sum() <= 32
    error = found.tip - tool.tip
    assert error @ np.linalg.solve(found.covariance[TIP, TIP], error) < chi2.isf(1e-4, 3)


def test_a_misfit_is_told_and_counts(rng):
    """A ball of 0.1 mm along each axis that rolls in a wide dimple: in the covariance, and measured to 4 sigma."""
    tool = pivot_films.draw_tool(rng)
    dimples = pivot_films.DIMPLE + 0.1 * rng.standard_normal((200, 3))
    poses = pivot_films.poses_of(pivot_films.turns(tool, rng), tool.tip, dimples)
    found = pivot.calibrate(frames_of(pivot_films.tracked(poses, rng)))
    assert abs(found.misfit_mm - 0.1) < 4 * 0.1 / np.sqrt(2 * 600) * 1.5
    error = found.tip - tool.tip
    assert error @ np.linalg.solve(found.covariance[TIP, TIP], error) < chi2.isf(1e-4, 3)


def test_neighbours_that_err_alike_count_as_fewer(rng):
    """A film in which the dimple wanders by 0.1 mm as slowly as over ten frames: errors are as predicted all the same."""
    squares = []
    for _ in range(8):
        tool = pivot_films.draw_tool(rng)
        wander = np.stack([np.convolve(rng.standard_normal(209), np.ones(10) / np.sqrt(10), "valid") for _ in range(3)], axis=1)
        poses = pivot_films.poses_of(pivot_films.turns(tool, rng), tool.tip, pivot_films.DIMPLE + 0.1 * wander)
        found = pivot.calibrate(frames_of(pivot_films.tracked(poses, rng)))
        error = found.tip - tool.tip
        squares.append(error @ np.linalg.solve(found.covariance[TIP, TIP], error))
    assert np.mean(squares) < 3 + 4 * np.sqrt(6 / 8)


def test_an_error_of_the_targets_own_frame_is_in_the_tip(rng):
    """The same wrong frame in all poses: the tip is found in that frame, at the right place of the world."""
    tool = pivot_films.draw_tool(rng)
    poses = pivot_films.poses_of(pivot_films.turns(tool, rng), tool.tip)
    wrong = rigid.from_rotation_vector([0.002, -0.003, 0.001], [0.2, 0.1, -0.3])
    found = pivot.calibrate(Frames(poses @ wrong, np.tile(np.diag([1e-8] * 3 + [1e-4] * 3), (200, 1, 1)), np.zeros((200, 6, 6))))
    np.testing.assert_allclose(found.tip, rigid.apply(rigid.invert(wrong), tool.tip), atol=1e-6)
    np.testing.assert_allclose(found.dimple, pivot_films.DIMPLE, atol=1e-6)


def test_poses_that_only_shift_tell_nothing(rng):
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, 3] = rng.standard_normal((50, 3))
    with pytest.raises(Undetermined):
        pivot.calibrate(Frames(poses, *np.zeros((2, 50, 6, 6))))
