"""Is it said in few words why frames have no pose?"""

from recon.tracking.track_figures import kind, kinds


def test_reasons_are_put_together():
    reasons = [
        None,
        "only camera 1 sees the target; camera 2: c0: 23 % of its rim seen",
        "only camera 1 sees the target; camera 2: c0: 12 % of its rim seen",
        "a misfit of 12 times the centres' uncertainty: other circles, or cameras swapped or moved",
        "camera 1: 0 of 3 circles; camera 2: 1 of 3 circles",
        "rays of c1 miss each other by 7.5 mm: other circles, or cameras swapped",
    ]
    assert kinds(reasons)[0] == ("only camera 1 sees the target", 2)
    assert [kind(str(reason)) for reason in reasons[3:]] == [
        "a misfit of … times the centres' uncertainty",
        "no camera sees all three circles",
        "rays of c1 miss each other by … mm",
    ]
    assert kinds([f"reason {letter}" for letter in "aabcdef"])[-1] == ("others", 2)
