"""Do the compiled sums and fits of profiles agree with plain ones?"""

import numpy as np
import pytest
import trimesh
from scipy.special import ndtr

from recon.segmentation import border_fit


def plain_misfit(rows, profile, weight):
    """Least weighted sum of squares over the levels of some rows, and the levels."""
    root = np.sqrt(weight)
    levels = np.linalg.lstsq(rows.T * root[:, None], profile * root, rcond=None)[0]
    return float((weight * (profile - levels @ rows) ** 2).sum()), levels


def test_misfits_are_those_of_least_squares(rng):
    """Of steps alone and with a line, over all blurs of a place; impossible ones never count."""
    s = np.linspace(-2.3, 2.3, 24)
    z = (s - np.array([-0.6, 0.0, 0.6])[:, None, None]) / np.array([0.3, 0.6])[:, None]
    trials = np.stack([ndtr(z), ndtr(-z), np.exp(-z * z / 2)], axis=2)
    profiles = rng.gamma(3, 1 / 3, (40, 24)) * np.where(s > 0.3, 1.0, 0.1)
    profiles[::2] += 3 * np.exp(-((s - 0.3) ** 2) / 0.2)
    profiles[:3] = profiles[:3, ::-1]  # steps down
    weight = rng.uniform(0.1, 3, profiles.shape)
    plain, lined = border_fit.misfits(profiles, weight, trials)
    assert (plain[:, :3] == border_fit.NEVER).all() and (plain < border_fit.NEVER).any() and (lined < border_fit.NEVER).any()
    for n, place in np.ndindex(len(profiles), len(trials)):
        fits = [plain_misfit(rows[:2], profiles[n], weight[n]) for rows in trials[place]]
        steps = [left for left, levels in fits if levels[0] > levels[1]]
        assert plain[place, n] == pytest.approx(min(steps, default=border_fit.NEVER), rel=1e-6)
        fits = [plain_misfit(rows, profiles[n], weight[n]) for rows in trials[place]]
        lines = [left for left, levels in fits if levels[0] > levels[1] and levels[2] > 0]
        assert lined[place, n] == pytest.approx(min(lines, default=border_fit.NEVER), rel=1e-6)


@pytest.mark.parametrize(("line", "share"), [(0.0, 0.3), (0.5, 0.01)])
def test_noise_alone_is_no_sure_border(line, share, rng):
    """Flat profiles step up here and there by speckle, where variances are no less than a border's; a line is known better."""
    s = border_fit.BIN_MM * (np.arange(24) + 0.5) - border_fit.REACH_MM
    speckle, weight = rng.gamma(20, 1 / 20, (2, 500, 24)), np.full((500, 24), 100.0)
    place, doubt = border_fit._steps(speckle[0] * (0.05 + 0.95 * ndtr(s / 0.3)), weight)
    assert place.std() < 0.15
    _, of_noise = border_fit._steps(speckle[1] * (0.08 + line * np.exp(-((s / 0.3) ** 2) / 2)), weight)
    assert np.median(of_noise) == border_fit.NEVER and of_noise.min() > share * np.median(doubt)


@pytest.mark.parametrize("patch_mm", [0.4, 5.0])
def test_neighbours_count_by_distance_and_direction(patch_mm, rng):
    """Of a thin plate as well, whose sides face away from each other: in many cubes, or all in one."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=3.0)
    places, normals = mesh.vertices * [1, 1, 0.1], np.asarray(mesh.vertex_normals)
    values = rng.normal(size=(len(places), 3))
    gaps = np.linalg.norm(places[:, None] - places, axis=2)
    share = np.exp(-(gaps**2) / (2 * patch_mm**2)) * np.clip(normals @ normals.T, 0, None)
    plain = np.where(gaps <= border_fit.FARTHEST * patch_mm, share, 0) @ values
    np.testing.assert_allclose(border_fit.mix(places, normals, values, patch_mm), plain, rtol=1e-9, atol=1e-9)


def test_smoothing_takes_spikes_and_keeps_the_volume(rng):
    """As trimesh's own filter does, whose neighbours are listed one by one."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=5.0)
    spiky = ball.vertices + rng.normal(0, 0.05, (len(ball.vertices), 1)) * ball.vertex_normals
    evened = border_fit.evened(ball, spiky)
    theirs = trimesh.smoothing.filter_taubin(trimesh.Trimesh(spiky, ball.faces, process=False), iterations=border_fit.EVENINGS)
    np.testing.assert_allclose(evened.vertices, theirs.vertices, atol=1e-12)
    assert np.linalg.norm(evened.vertices, axis=1).std() < 0.6 * np.linalg.norm(spiky, axis=1).std()
    assert evened.volume == pytest.approx(ball.volume, rel=0.01)
