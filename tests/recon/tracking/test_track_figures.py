"""Is it said in few words why frames have no pose, and what is amiss in all of them alike?"""

from dataclasses import replace

import numpy as np
import pytest

from recon.tracking import track_figures
from recon.tracking.pose_fit import Triangulated
from recon.tracking.results import Step
from recon.tracking.track_figures import kind, kinds
from recon.tracking.tracker import EXCHANGED


def test_reasons_are_put_together():
    reasons = [
        None,
        "only camera 1 sees the target; camera 2: c0: 23 % of its rim seen",
        "only camera 1 sees the target; camera 2: c0: 12 % of its rim seen",
        "a misfit of centres: 12 times their uncertainty; other circles, or cameras swapped or moved",
        "camera 1: 0 of 3 circles; camera 2: 1 of 3 circles",
        "rays that miss each other: of c1 by 7.5 mm; other circles, or cameras swapped",
    ]
    assert kinds(reasons)[0] == ("only camera 1 sees the target", 2)
    assert [kind(str(reason)) for reason in reasons[3:]] == [
        "a misfit of centres",
        "no camera sees enough circles",
        "rays that miss each other",
    ]
    assert kinds([f"reason {letter}" for letter in "aabcdef"])[-1] == ("others", 2)


def steps(rng, lengths, gap_mm, count=12, noise_mm=0.005):
    """Steps without poses, of six circles each."""
    nothing = np.full((6, 6), np.nan)
    triangles = [
        Triangulated(np.array(lengths) + noise_mm * rng.standard_normal(3), gap_mm + noise_mm * rng.standard_normal(3))
        for _ in range(count)
    ]
    return [Step(0, np.full((4, 4), np.nan), nothing, nothing, one, None, "a misfit", (0.0, 0.0), 0.01) for one in triangles]


@pytest.mark.parametrize(
    ("lengths", "gap_mm", "expected"),
    [
        ((25.0, 0.0, 40.0), 0.0, []),
        ((25.0, 0.0, 40.1), 0.0, ["target      off its design within the tolerance, c2 by +0.10 mm"]),
        ((25.0, 0.0, 41.1), 0.0, ["warning     the target's circles aren't where rig.target has them, off c2 by +1.10 mm"]),
        (
            (25.0, -1.2, 40.0),
            0.0,
            ["warning     the target's circles aren't where rig.target has them, off c2 aside by -1.20 mm"],
        ),
        (
            (25.0, 0.0, 40.0),
            0.31,
            ["warning     both cameras' rays miss each other by 0.31 mm, alike in 12 pairs: a camera was moved"],
        ),
    ],
)
def test_a_cause_of_all_pairs_is_named(rig, rng, lengths, gap_mm, expected):
    lines = list(track_figures.causes(steps(rng, lengths, gap_mm), rig.target))
    assert len(lines) == len(expected)
    assert all(line.startswith(start) for line, start in zip(lines, expected, strict=True))


def test_a_target_of_another_print_than_the_measured_one_is_named(rig, rng):
    measured = rig.target.model_copy(update={"covariance_mm2": tuple(map(tuple, (1e-5 * np.eye(3)).tolist()))})
    (line,) = track_figures.causes(steps(rng, (25.0, -0.22, 40.0), 0.0), measured)
    assert line.startswith("warning     the target isn't the one that was measured, off c2 aside by -0.22 mm, alike in 12 pairs")


def test_exchanged_cameras_and_true_causes_are_told_of_a_film(rig, rng):
    """Of three pairs exchanged, and of one whose circles left a view, and were too small in the other."""
    crossed = [replace(step, reason=EXCHANGED) for step in steps(rng, (25.0, 0.0, 40.0), 0.0, count=3)]
    gone = replace(
        crossed[0], reason="camera 1: out of view: c0, c2; camera 2: too small: circles of 12 px, expected 16 at least"
    )
    lines = [*track_figures.causes([*crossed, gone], rig.target)]
    assert lines[0].startswith("warning     cameras exchanged? In 3 of 4 pairs")
    told = track_figures.describe([gone], track_figures.measure([gone], rig.target))
    assert told[0] == "found       0 of 1 frames, 1 not: no camera sees enough circles (1)"
    assert told[1:3] == ["lost        camera 1: circles out of view (1)", "lost        camera 2: circles of less than 16 px (1)"]
    assert kind("camera 2: expected an image of 1280x1024, found 640x512") == "expected an image of 1280x1024, found 640x512"


def test_pairs_that_differ_have_no_cause_in_common(rig, rng):
    assert not list(track_figures.causes(steps(rng, (25.0, 0.0, 40.0), 0.0, noise_mm=0.5), rig.target))
    assert not list(track_figures.causes(steps(rng, (25.0, 0.0, 44.0), 1.0, count=3), rig.target))
