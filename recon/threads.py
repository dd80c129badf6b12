"""Threads: compiled loops over parts of a range, and work on the items of a stream, a few ahead of the results' use."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

import numba

Item = TypeVar("Item")
Result = TypeVar("Result")

PARTS = 8  # of a range for each thread, so that who is done helps the other


def in_threads(kernel: Callable[[int, int], Any], count: int) -> None:
    """Run `kernel(first, end)` over parts of range(count), in as many threads as Numba has; the caller's is one of them.

    What takes its time must release the interpreter's lock, as a `recon.compiled.kernel` does. A loop over Numba's `prange` would
    have all that is called within compiled thrice more, for each of the three functions that Numba makes of it.
    """
    threads = min(numba.get_num_threads(), count)
    if threads <= 1:
        kernel(0, count)
        return
    parts = min(PARTS * threads, count)
    left = deque((count * k // parts, count * (k + 1) // parts) for k in range(parts))

    def work() -> None:
        while True:
            try:
                first, end = left.popleft()
            except IndexError:
                return
            kernel(first, end)

    helpers = [_helpers().submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        left.clear()  # empty by now, but after an error
        for helper in helpers:
            if not helper.cancel():  # it has begun
                helper.result()


def mapped(work: Callable[[Item], Result], items: Iterable[Item], most: int | None = None) -> Iterator[Result]:
    """Results of `work`, in the items' order; pays where `work` releases the interpreter's lock.

    Items are taken one by one, one more than there are threads at most before their results are used.

    most : threads, where each takes much memory; as many as Numba has if not given.
    """
    threads = min(numba.get_num_threads(), most or numba.get_num_threads())
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque()
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@cache
def _helpers() -> ThreadPoolExecutor:
    """Threads beside those that call `in_threads`, kept, since making them takes as long as a small kernel."""
    return ThreadPoolExecutor(os.cpu_count(), "kernel")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a forked process has none of its parent's threads
