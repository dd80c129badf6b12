"""Does a phantom know where its wires are crossed, and refuse wires that are no N?"""

from dataclasses import replace

import numpy as np
import pytest

from recon.model.wire_phantom import FCAL_2, WirePhantom

FCAL = WirePhantom(np.array(FCAL_2, float))


def test_points_of_the_diagonals_lie_at_their_shares_between_the_sides():
    """By the intersection of each diagonal with the line between the sides, at three places along the wires."""
    for along in (3.0, 20.0, 31.0):
        share = along / 40
        first, middle, last = (FCAL.ends[:, k, 0] + share * (FCAL.ends[:, k, 1] - FCAL.ends[:, k, 0]) for k in range(3))
        shares = np.linalg.norm(middle - first, axis=1) / np.linalg.norm(last - first, axis=1)
        assert FCAL.on_diagonals(shares) == pytest.approx(middle)


def test_sections_are_the_sides_across_the_wires():
    assert FCAL.sections[:, :, 0].tolist() == [[30, 60], [30, 60], [35, 60]]
    assert np.abs(np.diff(FCAL.sections[:, 0, 1])) == pytest.approx([10, 10])


@pytest.mark.parametrize(("change", "said"), [
    (lambda ends: ends / 1000, r"wire of 5 to 500 mm, found 0.04 mm: another unit\?"),
    (lambda ends: ends[:, [1, 0, 2]], "N-wire 1 .* both sides"),
    (lambda ends: ends + np.array([0, 0, 1.0])[:, None, None] * [0, 0, 3.0], None),
    (lambda ends: np.concatenate([ends, ends[:1]]), "two at one depth"),
    (lambda ends: ends[:0], "1 to 8 N-wires, found 0"),
])  # fmt: skip
def test_wires_that_are_no_n_are_refused(change, said):
    ends = change(FCAL.ends)
    if said is None:
        ends = FCAL.ends.copy()
        ends[1, 1, :, 2] += 3.0
        said = "N-wire 2 .*the diagonal in the plane of its sides, found 3 mm beside it"
    with pytest.raises(ValueError, match=said):
        replace(FCAL, ends=ends)


def test_a_side_that_runs_back_to_front_is_refused():
    ends = FCAL.ends.copy()
    ends[2, 0] = ends[2, 0, ::-1]
    with pytest.raises(ValueError, match=r"N-wire 3 .*parallel, front to back, found 180 deg"):
        replace(FCAL, ends=ends)
