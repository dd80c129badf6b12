"""Are a tracker's errors what they are said to be, and its bounds where they should be?"""

from dataclasses import replace

import numpy as np
import pytest

from recon.capture import sweep_tables
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.tracks import Track
from twin.evaluation import track_errors
from twin.evaluation.track_errors import FilmTruth, compare, length_bound, measure, read_track


def truth(count: int) -> FilmTruth:
    poses = np.tile(rigid.from_rotation_vector([3.0, 0.2, 0.1], [5, -3, 660]), (count, 1, 1))
    return FilmTruth(
        np.arange(count) * 10**7, poses, np.full((count, 2, 3), 4.0), np.ones((count, 2, 3)), np.ones((count, 2, 3), bool)
    )


@pytest.mark.parametrize("sigma", [(1, 1, 1), (0.1, 0.1, 1), (0.3, 0.6, 1), (1e-6, 1e-6, 1)])
def test_the_bound_is_kept_by_as_many_as_it_says(sigma, rng):
    """95 % of 100 000 draws, to 0.7 %: the approximation's own error is half of that."""
    turn = rigid.from_rotation_vector([0.4, -1, 0.3], [0, 0, 0])[:3, :3]
    covariance = turn @ np.diag(np.square(sigma)) @ turn.T
    lengths = np.linalg.norm(rng.standard_normal((100_000, 3)) * sigma, axis=1)
    assert np.mean(lengths < length_bound(covariance)) == pytest.approx(0.95, abs=0.007)


def test_errors_are_those_that_were_made(rng):
    """Poses off by their covariance's own noise: 95 % keep to each bound."""
    expected, count = truth(400), 400
    sigma = np.array([1e-3, 1e-3, 3e-4, 0.01, 0.01, 0.08])
    found = expected.poses.copy()
    for pose, noise in zip(found, sigma * rng.standard_normal((count, 6)), strict=True):
        pose[:3, :3] = rigid.from_rotation_vector(noise[:3], [0, 0, 0])[:3, :3] @ pose[:3, :3]
        pose[:3, 3] += noise[3:]
    found[7] = np.nan
    errors = compare(Track(expected.times, found, np.tile(np.diag(sigma**2), (count, 1, 1))), expected)
    assert np.isnan(errors.shift_mm[7]) and errors.found.sum() == 399
    assert np.sqrt(np.nanmean(errors.shift_mm**2)) == pytest.approx(np.linalg.norm(sigma[3:]), rel=0.1)
    assert np.sqrt(np.nanmean(errors.turn_deg**2)) == pytest.approx(np.rad2deg(np.linalg.norm(sigma[:3])), rel=0.1)
    figures = measure(errors, expected)
    assert figures["track_within_bound"] == pytest.approx(0.95, abs=0.03)
    assert figures["track_shift_median_mm"] == pytest.approx(figures["track_shift_expected_mm"], rel=0.15)
    assert (figures["track_found"], figures["track_visible"], figures["track_visible_found"]) == (399, 400, 399)
    assert figures["track_false"] == 0 and figures["track_blur_most_px"] == 4


def test_a_patients_motion_is_no_error_of_poses_told_beside_it(tmp_path):
    """Whatever the patient did since the fringes, the probe is told where it was on the patient."""
    expected, moves = truth(3), [[0, 0, 0.05], [0.02, -0.1, 0], [0.1, 0, 0]]
    patient = rigid.from_rotation_vector([2.8, 0.1, 0.0], [-80, 60, 650])
    carried = np.stack([rigid.from_rotation_vector(turn, [20, 3 * k, -5]) for k, turn in enumerate(moves)])
    assert track_errors.beside_patient(expected, tmp_path, "scan") is expected
    for folder, poses in (("surface", patient), ("sweep/scan", carried @ patient)):
        (tmp_path / folder / "bodies").mkdir(parents=True)
        np.savez(tmp_path / folder / "bodies" / "patient.npz", world_from_target=poses)
    told = track_errors.beside_patient(replace(expected, poses=carried @ expected.poses), tmp_path, "scan")
    np.testing.assert_allclose(told.poses, expected.poses, atol=1e-9)
    (tmp_path / "surface" / "bodies" / "patient.npz").unlink()
    told = track_errors.beside_patient(replace(expected, poses=carried @ expected.poses), tmp_path, "scan")
    np.testing.assert_allclose(told.poses, carried[0] @ expected.poses, atol=1e-9)


def test_what_is_found_elsewhere_is_false():
    expected = truth(3)
    found = expected.poses.copy()
    found[0, :3, 3] += [3, 0, 0]
    found[1, :3, :3] = found[1, :3, :3] @ rigid.from_rotation_vector([0, 0, np.pi / 2], [0, 0, 0])[:3, :3]
    assert measure(compare(Track(expected.times, found), expected), expected)["track_false"] == 2


def test_nothing_found_gives_figures_that_are_unknown():
    expected = truth(2)
    figures = measure(compare(Track(expected.times, np.full((2, 4, 4), np.nan)), expected), expected)
    assert figures["track_found"] == 0 and np.isnan(figures["track_shift_median_mm"]) and np.isnan(figures["track_within_bound"])


def test_covered_circles_are_not_expected_to_be_found():
    expected = truth(3)
    expected.visible[0, 1, 2], expected.inside[1, 0, 0] = 0.5, False
    assert track_errors.visible_whole(expected).tolist() == [False, False, True]


def test_a_track_of_other_frames_is_refused(tmp_path):
    expected = truth(3)
    sweep_tables.write_track(tmp_path / "poses.csv", Track(expected.times[:2], expected.poses[:2]))
    with pytest.raises(InputError, match="expected the 3 frames of the film, found 2 others"):
        read_track(tmp_path / "poses.csv", expected)
