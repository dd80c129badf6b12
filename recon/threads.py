"""Threads: compiled loops over parts of a range, and work on the items of a stream, a few ahead of the results' use."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from threading import RLock
from typing import Any, TypeVar

import cv2
import numba

Result = TypeVar("Result")

PARTS_A_THREAD = 8  # of a range, so that idle threads take over
_OPENCV = RLock()  # of its number of threads


def in_threads(kernel: Callable[..., Any], count: int, *arguments: Any) -> None:
    """Run `kernel(first, end, *arguments)` over parts of range(count), in as many threads as Numba has, the caller's included.

    Slow code must release the interpreter's lock, as a `recon.compiled.kernel` does. A loop over Numba's `prange` would
    have all that is called within compiled thrice more, for each of the three functions that Numba makes of it.
    """
    threads = min(numba.get_num_threads(), count)
    if threads <= 1:
        kernel(0, count, *arguments)
        return
    parts = min(PARTS_A_THREAD * threads, count)
    ends = [-(-count * k // parts) for k in range(parts + 1)]  # a larger part isn't the last one, which the others wait for
    left = deque(pairwise(ends))

    def work() -> None:
        while True:
            try:
                first, end = left.popleft()
            except IndexError:
                return
            try:
                kernel(first, end, *arguments)
            except BaseException:
                left.clear()  # what is left would be in vain
                raise

    helpers = [_helpers().submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)  # or they would go on writing after an error
    for helper in begun:
        helper.result()


def mapped(work: Callable[..., Result], *streams: Iterable[Any], most: int | None = None) -> Iterator[Result]:
    """Results of `work`, called with an item of each stream, in order; pays where it releases the interpreter's lock.

    Items are taken one by one, one more than there are threads at most before their results are used. Loops `in_threads`
    within `work` share the threads that are left.

    most : threads, where each takes much memory; as many as Numba has if not given.
    """
    count = numba.get_num_threads()
    threads = min(count, most or count)
    pool = ThreadPoolExecutor(threads, initializer=numba.set_num_threads, initargs=(count // threads,))
    waiting = deque[Future[Result]]()
    try:
        for items in zip(*streams, strict=True):
            waiting.append(pool.submit(work, *items))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)  # of those that nobody waits for any more


@contextmanager
def opencv_on_one_thread() -> Iterator[None]:
    """Let OpenCV add up in one order meanwhile, for the same bits at each call; for all of the process, so one at a time."""
    with _OPENCV:
        count = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            yield
        finally:
            cv2.setNumThreads(count)


@cache
def _helpers() -> ThreadPoolExecutor:
    """Threads beside those that call `in_threads`, kept, since making them takes as long as a small kernel."""
    return ThreadPoolExecutor(os.cpu_count(), "kernel")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a forked process has none of its parent's threads
