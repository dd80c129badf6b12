"""Is a range shared among threads, and do results of a stream come in its order, only a few items ahead of their use?"""

import os
import threading
import time

import numba
import pytest

from recon.threads import in_threads, mapped
from tests.patience import PATIENCE_S


@pytest.mark.parametrize("count", [0, 1, 3, 100])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_share_a_range(monkeypatch, threads, count):
    """Each number once, in at most so many threads."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: threads)
    done, names = [], set()

    def part(first, end, numbers, others):
        numbers.extend(range(first, end))
        others.add(threading.get_ident())

    in_threads(part, count, done, names)
    assert sorted(done) == list(range(count))
    assert len(names) <= threads


def test_a_mistake_in_a_thread_is_raised(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda first, end: 1 / (first - 1), 2)


def test_loops_within_loops_and_side_by_side_come_to_an_end(monkeypatch):
    """However few threads there are: who calls works, too."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: 4 * (os.cpu_count() or 1))
    done = []

    def outer(first, end):
        for _ in range(first, end):
            in_threads(lambda low, high: done.extend(range(low, high)), 50)

    list(mapped(lambda _: in_threads(outer, 6), range(5)))
    assert sorted(done) == sorted(5 * 6 * list(range(50)))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks on this system")
def test_a_forked_process_has_threads_of_its_own(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    meet()  # makes this process's threads
    child = os.fork()
    if child == 0:
        status = 1
        try:
            meet()
            status = 0
        finally:
            os._exit(status)
    assert os.waitpid(child, 0)[1] == 0


def meet():
    """Run two parts that wait for each other; `BrokenBarrierError` after a while if one thread is to do both."""
    barrier = threading.Barrier(2, timeout=PATIENCE_S)
    in_threads(lambda first, end: barrier.wait(), 2)


def test_parts_run_side_by_side(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    meet()


def test_after_a_mistake_nothing_runs_on(monkeypatch):
    """The other threads end their parts first, and begin no further ones."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    barrier, ended, begun = threading.Barrier(2, timeout=PATIENCE_S), [], []

    def part(first, end):
        begun.append(first)
        if len(begun) <= 2:
            barrier.wait()
        if threading.current_thread() is threading.main_thread():
            raise ZeroDivisionError
        time.sleep(0.05)
        ended.append(first)

    with pytest.raises(ZeroDivisionError):
        in_threads(part, 1000)
    assert len(ended) == 1 and len(begun) == 2
    time.sleep(0.1)
    assert len(ended) == 1


def test_results_are_in_order_and_items_are_taken_one_by_one():
    taken = []

    def items():
        for k in range(20):
            taken.append(k)
            yield k

    def work(k: int) -> int:
        time.sleep(0.003 * (k % 3))
        return k * k

    for k, result in enumerate(mapped(work, items())):
        assert result == k * k
        assert len(taken) <= k + 2 + numba.get_num_threads()
    assert len(taken) == 20


def test_loops_within_work_share_the_threads_that_are_left():
    before = numba.get_num_threads()

    def work(_: int) -> int:
        return numba.get_num_threads()

    assert set(mapped(work, range(20))) == {1}
    assert set(mapped(work, range(20), most=1)) == {before}
    assert numba.get_num_threads() == before  # the caller's own


def test_streams_are_taken_side_by_side_and_end_together():
    assert list(mapped(lambda a, b: 10 * a + b, [1, 2, 3], iter([4, 5, 6]))) == [14, 25, 36]
    with pytest.raises(ValueError, match="shorter"):
        list(mapped(lambda a, b: None, [1, 2, 3], [4, 5]))


def test_no_more_than_some_items_are_worked_on_at_once(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 8)
    monkeypatch.setattr(numba, "set_num_threads", lambda count: None)  # more than one core has
    working, most, lock = 0, 0, threading.Lock()

    def work(_: int) -> None:
        nonlocal working, most
        with lock:
            working += 1
            most = max(most, working)
        time.sleep(0.002)
        with lock:
            working -= 1

    list(mapped(work, range(30), most=3))
    assert most <= 3


def test_nobody_works_for_one_who_left():
    """Items that were not begun when the results' user went away are given up."""
    begun = []

    def work(k: int) -> int:
        begun.append(k)
        time.sleep(0.02)
        return k

    results = mapped(work, range(100), most=1)
    next(results)
    results.close()
    assert len(begun) <= 3


def test_faults_are_passed_on():
    with pytest.raises(ZeroDivisionError):
        list(mapped(lambda k: 1 // k, [1, 0]))
