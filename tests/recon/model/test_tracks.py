"""A track in a reference's frame: the motion of the reference is undone, and its errors are in the covariance."""

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.model import tracks
from recon.model.tracks import Track

COUNT = 4
SPREAD = np.array([1e-4] * 3 + [1e-2] * 3)  # rad and mm


def poses(rng, count=COUNT):
    turns = Rotation.random(count, rng=rng).as_matrix()
    return np.array([rigid.transform(turn, rng.normal([0, 0, 600], 100)) for turn in turns])


def covariances(rng, count=COUNT):
    roots = rng.normal(size=(count, 6, 6)) * SPREAD
    return np.swapaxes(roots, 1, 2) @ roots


def track(places, own=None, shared=None):
    return Track(np.arange(len(places)), places, own, shared)


def test_what_moves_with_the_reference_is_at_rest_in_its_frame(rng):
    """A body that is fixed to the reference, wherever that goes, has one pose: that beside the first pose."""
    reference, held, start = poses(rng), poses(rng, 1)[0], poses(rng, 1)
    found = tracks.relative(track(reference @ held), track(reference), track(start))
    assert np.allclose(found.poses, start[0] @ held, atol=1e-9)


def test_a_reference_at_rest_changes_nothing(rng):
    start, moved = poses(rng, 1), poses(rng)
    found = tracks.relative(track(moved), track(np.repeat(start, COUNT, axis=0)), track(start))
    assert np.allclose(found.poses, moved, atol=1e-9)


def test_there_is_no_pose_where_either_is_lost(rng):
    moved, reference = poses(rng), poses(rng)
    moved[1], reference[2] = np.nan, np.nan
    found = tracks.relative(track(moved), track(reference), track(poses(rng, 1)))
    assert found.found.tolist() == [True, False, False, True]


def test_the_covariance_is_that_of_drawn_errors(rng):
    """Noise of the three poses is independent; what the reference shares errs alike in its first pose."""
    moved, reference, start = poses(rng), poses(rng), poses(rng, 1)
    own, of_reference, of_start = covariances(rng), covariances(rng), covariances(rng, 1)
    shared, alike = (np.repeat(covariances(rng, 1), COUNT, axis=0) for _ in range(2))
    found = tracks.relative(track(moved, own, shared), track(reference, of_reference, alike), track(start, of_start, alike[:1]))
    draws = 4000

    def drawn(covariance):
        return rng.multivariate_normal(np.zeros(6), covariance, draws)

    def around(pose, steps):
        return rigid.moved(np.repeat(pose[None], draws, axis=0), steps)

    first, common = drawn(of_start[0]), drawn(alike[0])
    for k in range(COUNT):
        bodies = around(moved[k], drawn(own[k] + shared[k]))
        references = around(reference[k], drawn(of_reference[k]) + common)
        seen = around(start[0], first + common) @ np.linalg.inv(references) @ bodies
        off = np.array([rigid.difference(found.poses[k], one) for one in seen])
        root = np.linalg.inv(np.linalg.cholesky(found.covariance[k] + found.shared[k]))
        assert np.abs(np.linalg.eigvalsh(root @ np.cov(off.T) @ root.T) - 1).max() < 0.15  # 6 sigma of 4000 draws


def test_tracks_of_other_moments_and_missing_first_poses_are_refused(rng):
    moved = track(poses(rng))
    with pytest.raises(InputError, match="poses at the track's 4 moments"):
        tracks.relative(moved, track(poses(rng, 3)), track(poses(rng, 1)))
    with pytest.raises(InputError, match="at_first: expected a pose"):
        tracks.relative(moved, track(poses(rng)), track(np.full((1, 4, 4), np.nan)))


def test_poses_from_a_body_are_exact_and_have_the_noise_of_both(rng):
    """As relative to a body that stood at the origin of its own frame, exactly."""
    moved, body, own, of_body = poses(rng), poses(rng), covariances(rng), covariances(rng)
    found = tracks.from_body(track(moved, own), track(body, of_body))
    assert np.allclose(found.poses, np.linalg.inv(body) @ moved, atol=1e-9)
    draws = 4000
    for k in range(COUNT):
        steps = [rng.multivariate_normal(np.zeros(6), each[k], draws) for each in (own, of_body)]
        bodies, references = (
            rigid.moved(np.repeat(pose[None], draws, axis=0), step) for pose, step in zip((moved[k], body[k]), steps, strict=True)
        )
        off = np.array([rigid.difference(found.poses[k], one) for one in np.linalg.inv(references) @ bodies])
        root = np.linalg.inv(np.linalg.cholesky(found.covariance[k]))
        assert np.abs(np.linalg.eigvalsh(root @ np.cov(off.T) @ root.T) - 1).max() < 0.15  # 6 sigma of 4000 draws


def test_a_body_of_other_moments_is_interpolated(rng):
    """Halfway its variance is half of two poses'; beyond its track there is no pose."""
    held = poses(rng, 1)[0]
    course = np.array([rigid.transform(held[:3, :3], held[:3, 3] + [10.0 * k, 0, 0]) for k in range(3)])
    times = np.array([0, 100, 200]) * 10**6
    halfway = Track(np.array([50, 150, 250]) * 10**6, np.repeat(held[None], 3, axis=0), np.zeros((3, 6, 6)))
    found = tracks.from_body(halfway, Track(times, course, np.tile(np.eye(6), (3, 1, 1))))
    assert found.found.tolist() == [True, True, False]
    assert np.allclose(found.poses[0, :3, 3], held[:3, :3].T @ [-5.0, 0, 0])
    assert np.allclose(found.covariance[0, :3, :3], np.eye(3) / 2)


def test_a_body_that_was_lost_for_a_moment_has_the_noise_of_the_poses_around(rng):
    """Weights of all pairs of moments give the same; what errs alike isn't averaged."""
    count = 30
    body = Track(np.arange(count) * 10**7, poses(rng, count), covariances(rng, count), covariances(rng, count))
    body.poses[[4, 11, 12]] = np.nan
    still = np.repeat(np.eye(4)[None], count, axis=0)
    times = np.sort(rng.integers(0, (count - 1) * 10**7, count))
    found = tracks.from_body(Track(times, still, np.zeros((count, 6, 6)), np.zeros((count, 6, 6))), body)
    shares = tracks.shares_at(body, times, 0.0)
    own, alike = (np.einsum("nm,mij->nij", *each) for each in (
        (shares**2, body.covariance[body.found]), (shares, body.shared[body.found])
    ))  # fmt: skip
    there = Track(times, tracks.at(body, times), own, alike)
    expected = tracks.from_body(Track(times, still, np.zeros((count, 6, 6)), np.zeros((count, 6, 6))), there)
    assert np.allclose(found.covariance, expected.covariance, rtol=1e-9) and np.allclose(found.shared, expected.shared, rtol=1e-9)


def test_minutes_of_another_body_take_no_matrix_of_all_pairs_of_moments():
    """Memory grows with the moments, not with their square."""
    count = 3000
    body, moved = (
        Track(np.arange(count) * 10**7 + later, np.repeat(np.eye(4)[None], count, axis=0), np.tile(np.eye(6), (count, 1, 1)))
        for later in (0, 10**6)
    )
    tracemalloc.start()
    try:
        tracks.from_body(moved, body)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 8 * count**2
