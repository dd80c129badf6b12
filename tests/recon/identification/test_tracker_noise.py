"""A tracker's noise, in a stand and in a hand, and its drop-outs are found as well as is said."""

import numpy as np
import pytest

from recon.identification import hand_motion, tracker_noise
from tests.recon.identification.made_recordings import Hand, cameras, record


def still(rig, *made):
    """Findings on targets in a stand."""
    gaps = [tracker_noise.gaps_of(one, cameras(rig)) for one in made]
    rays = hand_motion.find_trigger(gaps, "made").estimates["tracker.rays_over_predicted"]
    return tracker_noise.still_noise(made, rays, "made")


def test_noise_in_a_stand_is_the_noise(rig):
    """Of 16 recordings: over the predicted one, in px, in mm and in deg, 85 or more of 100 intervals hold the truth."""
    held = []
    for seed in range(16):
        noise = np.random.default_rng(seed).uniform(0.7, 1.4)
        one = record(rig, Hand(noise=noise, count=60), seed)
        known = still(rig, one).estimates
        turn, shift = (np.sqrt(np.trace(one.covariance[0][axes, axes])) for axes in (slice(0, 3), slice(3, 6)))
        truth = {"centre_px": 0.01, "centre_over_predicted": 1.0, "noise_mm": shift, "noise_deg": np.rad2deg(turn)}
        truth |= {"pose_over_predicted": 1.0}
        found = {name: known[f"tracker.{name}"] for name in truth}
        held += [abs(one.value - noise * truth[name]) < 1.96 * one.sigma for name, one in found.items()]
    assert 0.85 < np.mean(held) < 0.99


def test_warmth_doesnt_count_and_a_hand_isnt_a_stand(rig):
    """A slow drift of ten times the noise is taken off; a tremor is refused, as rays don't scatter like poses."""
    one = record(rig, Hand(count=60), 3)
    poses = one.poses.copy()
    poses[:, :3, 3] += 0.2 * one.times[:, None]
    drifted = still(rig, one._replace(poses=poses)).estimates["tracker.noise_mm"]
    assert drifted.value == pytest.approx(still(rig, one).estimates["tracker.noise_mm"].value, rel=1e-3)
    told = still(rig, record(rig, Hand(0.2, 0.2, count=60), 3))
    assert "moves in made" in told.unknown["tracker.noise_mm"] and not told.estimates


def test_noise_in_a_hand_is_told_by_rays_over_light(rig):
    """Fast, trembling and with jitter of triggers: dark frames of twice the noise, light ones of half of it, within 3.5 sigma."""
    made = [
        record(rig, Hand(0.1, 0.1, 5e-4, 40.0, noise), seed, contrast, centre_px)
        for seed, (contrast, centre_px, noise) in enumerate([(12.0, 0.04, 2.0), (90.0, 0.008, 0.5)])
    ]
    found = tracker_noise.noise_table([(one, tracker_noise.gaps_of(one, cameras(rig))) for one in made], "made").estimates
    for part, noise, centre_px in (("contrast_8_to_15_dn", 2.0, 0.08), ("contrast_60_to_120_dn", 0.5, 0.004)):
        name = f"tracker.{part}.smear_0_to_1_px"
        over, size = found[f"{name}.over_predicted"], found[f"{name}.centre_px"]
        assert abs(over.value - noise) < 3.5 * over.sigma and over.sigma < 0.1 * noise
        assert abs(size.value - centre_px) < 3.5 * size.sigma
    assert len(found) == 4


def test_gaps_scatter_as_their_variances_say(rig):
    gaps = tracker_noise.gaps_of(record(rig, Hand(count=400), 2), cameras(rig))
    assert np.mean(gaps.mm**2 / gaps.variances) == pytest.approx(1, abs=5 * np.sqrt(2 / gaps.mm.size))
    assert np.abs(gaps.normals @ [0, 1, 0]).min() > 0.95


def test_drop_outs_are_counted_in_view_with_wilsons_interval(rig):
    """3 of 50 are 2.1 to 16.2 % [Wilson 1927]; frames that the target has left don't count."""
    one = record(rig, Hand(count=60), 1)
    poses, in_view = one.poses.copy(), one.in_view.copy()
    poses[[5, 20, 30]] = poses[50:] = np.nan
    in_view[50:] = False
    found = tracker_noise.drop_outs([one._replace(poses=poses, in_view=in_view)], "made").estimates
    told = found["tracker.dropped"]
    assert told.value - 1.96 * told.sigma == pytest.approx(0.0206, abs=2e-4)
    assert told.value + 1.96 * told.sigma == pytest.approx(0.1622, abs=2e-4)
    assert told.source.startswith("3 of 50 pairs") and "10 out of view" in told.source
    assert found["tracker.contrast_60_to_120_dn.smear_0_to_1_px.dropped"].value == told.value


def test_a_film_without_any_pose_tells_its_drop_outs_alone(rig):
    one = record(rig, Hand(count=40), 1)
    nothing = one._replace(poses=np.full_like(one.poses, np.nan))
    assert list(tracker_noise.drop_outs([nothing], "made").estimates) == ["tracker.dropped"]
    assert not len(tracker_noise.gaps_of(nothing, cameras(rig)).mm)
    assert "needs 30 poses" in tracker_noise.still_noise([nothing], None, "made").unknown["tracker.centre_px"]
