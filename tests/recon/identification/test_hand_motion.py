"""A hand's tremor, jitter of triggers and a bracket's giving are found in made recordings as well as is said."""

import numpy as np
import pytest

from recon.identification import hand_motion, tracker_noise
from recon.identification.hand_motion import GIVE, GIVE_TURN, TREMOR, TRIGGER, TURN
from recon.model import circle_layout
from tests.recon.identification.made_recordings import Hand, cameras, record

MOVING = "tracker.moving_shift_over_predicted", "tracker.moving_turn_over_predicted"


def found_in(rig, *made):
    """Findings on tremor of some recordings."""
    return hand_motion.find_tremor([one.tracked for one in made], [circle_layout.middle(rig.target)] * len(made), "made")


def drawn(rng) -> Hand:
    return Hand(
        tremor_mm=rng.uniform(0.01, 0.2), tremor_deg=rng.uniform(0.01, 0.2), led_mm=15.0, noise=rng.uniform(0.7, 1.6),
        hz=float(rng.choice([30.0, 40.0])), count=100,
    )  # fmt: skip


def errors(rig, seed: int) -> dict[str, float]:
    """Of a drawn hand, in sigmas."""
    hand = drawn(np.random.default_rng(seed))
    known = found_in(rig, record(rig, hand, seed)).estimates
    truth = {TREMOR: hand.tremor_mm, TURN: hand.tremor_deg} | dict.fromkeys(MOVING, hand.noise)
    return {name: (known[name].value - true) / known[name].sigma for name, true in truth.items()}


def test_a_trembling_hand_is_told_from_noise(rig):
    """Both strengths and both noises within 3.5 sigma, tremor to a fifth in three seconds."""
    assert max(map(abs, errors(rig, 3).values())) < 3.5
    known = found_in(rig, record(rig, Hand(0.1, 0.1, led_mm=15.0), 5)).estimates
    assert known[TREMOR].sigma < 0.02 and known[TURN].sigma < 0.02


@pytest.mark.slow
def test_intervals_hold_the_truth(rig):
    """Of 60 hands drawn at random: 90 to 98.5 of 100 numbers lie within 1.96 sigma, and of each of the four 85 or more."""
    off = np.array([list(errors(rig, seed).values()) for seed in range(1000, 1060)])
    inside = np.abs(off) < 1.96
    assert 0.90 <= inside.mean() <= 0.985
    assert (inside.mean(axis=0) >= 0.85).all()


def test_a_calm_hand_has_no_tremor_beyond_the_noise(rig):
    """None can't be excluded, and is in the interval; an upper limit of a fifth of the noise."""
    known = found_in(rig, record(rig, Hand(led_mm=15.0, count=120), 8)).estimates[TREMOR]
    assert known.value < 1.96 * known.sigma < 0.02 and "none can't be excluded" in known.source


def test_longer_recordings_tell_more(rig):
    """Sigma falls with the root of the time, but for what the band's shape leaves: here four times as long, by a half."""
    few, many = (found_in(rig, record(rig, Hand(0.1, 0.1, count=count), 6)).estimates[TREMOR].sigma for count in (75, 300))
    assert 0.3 < many / few < 0.75


def test_several_recordings_and_drop_outs_count_together(rig):
    """Each has a course of its own, also where it begins elsewhere; lost poses leave gaps."""
    made = []
    for seed in range(3):
        one = record(rig, Hand(0.1, 0.1, led_mm=15.0), seed)
        poses = one.poses.copy()
        poses[np.random.default_rng(seed).random(len(poses)) < 0.1] = np.nan
        made.append(one._replace(poses=poses))
    known = found_in(rig, *made).estimates
    assert abs(known[TREMOR].value - 0.1) < 3.5 * known[TREMOR].sigma
    assert known[TREMOR].sigma < 0.75 * found_in(rig, made[0]).estimates[TREMOR].sigma


def test_what_cant_be_seen_is_unknown(rig):
    """Tremor at 20 frames a second, which show 12 Hz as 8; in half a second; of a hand that shakes at 6.5 Hz, too."""
    slow = found_in(rig, record(rig, Hand(0.1, 0.1, hz=20.0), 1))
    assert "27 frames a second" in slow.unknown[TREMOR] and TREMOR not in slow.estimates
    assert "needs 40 poses" in found_in(rig, record(rig, Hand(0.1, 0.1, count=20), 1)).unknown[TURN]
    one = record(rig, Hand(0.1, 0.1, hz=40.0), 2)
    poses = one.poses.copy()
    poses[:, :3, 3] += 5 * np.sin(2 * np.pi * 14 * one.times)[:, None]
    shaky = found_in(rig, one._replace(poses=poses))
    assert "moves beside 8 to 12 Hz" in shaky.unknown[TREMOR] and TURN in shaky.estimates


def jitter(rig, hand: Hand, seed: int):
    return hand_motion.find_trigger([tracker_noise.gaps_of(record(rig, hand, seed), cameras(rig))], "made")


def test_jitter_of_triggers_shows_in_a_moving_target(rig):
    """0.3 ms to 3.5 sigma; none of a target at rest."""
    hand = Hand(trigger_s=3e-4, led_mm=40.0, noise=1.3, count=120)
    known = jitter(rig, hand, 4).estimates
    assert abs(known[TRIGGER].value - 3e-4) < 3.5 * known[TRIGGER].sigma and known[TRIGGER].sigma < 1e-4
    noise = known["tracker.rays_over_predicted"]
    assert abs(noise.value - 1.3) < 3.5 * noise.sigma
    assert "moves across" in jitter(rig, hand._replace(led_mm=0.0), 4).unknown[TRIGGER]


@pytest.mark.slow
def test_intervals_of_jitter_hold_the_truth(rig):
    """Of 60 triggers and noises of rays drawn at random 87 % or more of each lie within 1.96 sigma, and not nearly all."""
    off = []
    for seed in range(2000, 2060):
        rng = np.random.default_rng(seed)
        hand = Hand(0.05, 0.05, rng.uniform(5e-5, 1e-3), rng.uniform(20, 50), rng.uniform(0.7, 1.6), count=60)
        known = jitter(rig, hand, seed).estimates
        pairs = (known[TRIGGER], hand.trigger_s), (known["tracker.rays_over_predicted"], hand.noise)
        off.append([(one.value - true) / one.sigma for one, true in pairs])
    inside = (np.abs(off) < 1.96).mean(axis=0)
    assert (inside >= 0.87).all() and inside.mean() <= 0.99


def test_a_brackets_giving_is_found_from_pairs_of_calibrations():
    """Of 200 brackets with two sessions each, intervals hold nine in ten or more; errors of calibrations are taken off."""
    held = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        size = np.repeat([np.deg2rad(rng.uniform(0, 0.5)), rng.uniform(0, 0.5)], 3)
        own = np.diag(np.repeat([1e-3, 0.05], 3)) ** 2
        steps = size * rng.standard_normal((2, 6)) + rng.standard_normal((2, 6)) @ np.sqrt(own)
        known = hand_motion.bracket_give(steps, np.tile(own, (2, 1, 1)), "made").estimates
        off = known[GIVE].value - size[3], known[GIVE_TURN].value - np.rad2deg(size[0])
        held.append(np.abs(off) < 1.96 * np.array([known[GIVE].sigma, known[GIVE_TURN].sigma]))
    assert (np.mean(held, axis=0) > 0.9).all()
