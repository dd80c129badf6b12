"""Linear algebra on one thread, however many it had before, and has again."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from recon import linear_algebra


def threads() -> set[int]:
    """Numbers of threads of all libraries for linear algebra."""
    return {library["num_threads"] for library in ThreadpoolController().select(user_api="blas").info()}


@pytest.fixture(autouse=True)
def three_threads():
    """As in a process that has loaded NumPy without further ado, on three cores."""
    assert np.linalg.det(np.eye(2)) == 1
    with threadpool_limits(3, "blas"):
        assert threads() == {3}
        yield


def test_the_number_of_threads_comes_back():
    with linear_algebra.on_one_thread():
        with linear_algebra.on_one_thread():
            assert threads() == {1}
        assert threads() == {1}
    assert threads() == {3}
    with pytest.raises(ZeroDivisionError), linear_algebra.on_one_thread():
        raise ZeroDivisionError
    assert threads() == {3}


def test_threads_that_come_and_go_within_change_nothing():
    """As poses of the board, which are looked at in threads of their own."""

    @linear_algebra.on_one_thread()
    def work(_: int) -> set[int]:
        return threads()

    with linear_algebra.on_one_thread(), ThreadPoolExecutor(2) as pool:
        assert list(pool.map(work, range(4))) == [{1}] * 4
        assert threads() == {1}
    assert threads() == {3}
