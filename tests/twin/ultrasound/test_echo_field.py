"""The sum of the parts' echoes."""

import numba
import numpy as np

from twin.ultrasound.echo_field import PARTS, laid


def test_parts_are_summed_over_the_lines_that_they_touch(rng):
    """The same bytes from any number of threads: each part begins with an empty field, whichever were laid before."""
    values = rng.standard_normal((PARTS, 20, 7)).astype(np.complex64)
    touched = np.sort(rng.integers(-3, 24, (PARTS, 2)), axis=1)

    def lay(field, part):
        low, high = np.clip(touched[part], 0, 20)
        field[low:high] += values[part, low:high]
        return touched[part]

    lines = np.arange(20)
    expected = np.zeros((20, 7), np.complex64)
    for part, (low, high) in zip(values, touched, strict=True):
        expected += np.where((lines >= low) & (lines < high), part.T, 0).T
    assert np.array_equal(laid(lay, np.zeros((20, 7), np.complex64)), expected)
    numba.set_num_threads(1)
    try:
        assert np.array_equal(laid(lay, np.zeros((20, 7), np.complex64)), expected)
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
