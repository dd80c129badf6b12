"""Do results come in the items' order, while only a few items are taken ahead of them?"""

import time

import numba
import pytest

from recon.segmentation import prefetch


def test_results_are_in_order_and_items_are_taken_one_by_one():
    taken = []

    def items():
        for k in range(20):
            taken.append(k)
            yield k

    def work(k: int) -> int:
        time.sleep(0.003 * (k % 3))
        return k * k

    for k, result in enumerate(prefetch.mapped(work, items())):
        assert result == k * k
        assert len(taken) <= k + 2 + numba.get_num_threads()
    assert len(taken) == 20


def test_faults_are_passed_on():
    with pytest.raises(ZeroDivisionError):
        list(prefetch.mapped(lambda k: 1 // k, [1, 0]))
