"""The sum of the parts' echoes."""

import numpy as np
import pytest

from twin.ultrasound.echo_field import PARTS, summed


def test_parts_are_summed_over_the_lines_that_they_touch(rng):
    fields = rng.standard_normal((PARTS, 20, 7)).astype(np.complex64)
    touched = np.sort(rng.integers(0, 21, (PARTS, 2)), axis=1)
    expected = sum(
        np.where((np.arange(20) >= low) & (np.arange(20) < high), part.T, 0).T
        for part, (low, high) in zip(fields, touched, strict=True)
    )
    assert summed(fields, touched) == pytest.approx(expected, abs=1e-5)
