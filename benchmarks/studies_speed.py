"""Tasks on workers: the cost of handing them out, beside a plain pool of processes; many short ones; a worker that is killed."""

import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil

from twin.engine import Engine, results
from twin.experiments.table_rows import Measurement, Row

WORKERS = 2
LONG_S, LONG = 10.0, 12  # tasks of ten seconds
SHORT = 10_000
LOCAL, DASK = Engine(workers=WORKERS), Engine(name="dask", workers=WORKERS)


def measurements() -> list[Measurement]:
    """The rows of the group."""
    return [lambda: long_tasks("local", LOCAL), lambda: long_tasks("dask", DASK), lambda: short_tasks("local", LOCAL),
            lambda: short_tasks("dask", DASK), lambda: killed("local", LOCAL), lambda: killed("dask", DASK)]  # fmt: skip


def rest(k: int) -> int:
    """A long task that needs no core, so that the machine's own load doesn't count."""
    time.sleep(LONG_S)
    return k


def square(k: int) -> int:
    """A short task."""
    return k * k


def rest_or_die(k: int, folder: str) -> int:
    """A short rest; the fourth task's process is killed once."""
    mark = Path(folder) / str(k)
    again = mark.exists()
    mark.write_text("begun")
    if k == 3 and not again:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(1.0)
    return k


def long_tasks(name: str, engine: Engine) -> list[Row]:
    """Time beyond the tasks' own, from the first result to the last: the start of the workers is apart."""
    moments = [time.perf_counter()]
    for _ in results(engine, rest, ((k,) for k in range(LONG + WORKERS))):
        moments.append(time.perf_counter())
    over = 100 * ((moments[-1] - moments[WORKERS]) / (LONG / WORKERS * LONG_S) - 1)
    peer = 100 * (_by_a_plain_pool() / (LONG / WORKERS * LONG_S) - 1) if engine is LOCAL else None
    what = f"{name}: {LONG} tasks of {LONG_S:.0f} s, {WORKERS} workers"
    start = moments[1] - moments[0] - LONG_S
    return [
        Row("f", f"{what}: time over the tasks' own (peer: a plain pool of processes)", over, 5.0, peer, "%"),
        Row("f", f"{what}: start of the workers", start, None, None, "s"),
    ]


def _by_a_plain_pool() -> float:
    """Seconds that the standard library's pool takes, once its processes have begun."""
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        list(pool.map(rest, range(WORKERS)))
        start = time.perf_counter()
        list(pool.map(rest, range(LONG)))
        return time.perf_counter() - start


def short_tasks(name: str, engine: Engine) -> list[Row]:
    """Rates of the tenths of many short tasks, and the growth of this process's memory."""
    process, moments, memory = psutil.Process(), [time.perf_counter()], []
    for done, _ in zip(count(1), results(engine, square, _numbers()), strict=False):
        if done % (SHORT // 10) == 0:
            moments.append(time.perf_counter())
            memory.append(process.memory_info().rss / 1e6)
    seconds = np.diff(moments)[1:]  # the first tenth has the workers' start in it
    what = f"{name}: {SHORT} tasks that do nothing"
    return [
        Row("f", f"{what}: tasks a second", SHORT / 10 / float(np.median(seconds)), None, None, "1/s"),
        Row("f", f"{what}: slowest tenth over the fastest", float(seconds.max() / seconds.min()), 1.5, 1.0, ""),
        Row("f", f"{what}: growth of memory from the second tenth to the last", memory[-1] - memory[1], 50.0, 0.0, "MB"),
    ]


def _numbers() -> Iterator[tuple[int]]:
    return ((k,) for k in range(SHORT))


def killed(name: str, engine: Engine) -> list[Row]:
    """Tasks that are begun again because a worker is killed in the middle."""
    with TemporaryDirectory() as folder:
        done = sorted(results(engine, rest_or_die, ((k, folder) for k in range(8))))
    what = f"{name}: results of 8 tasks, a worker killed at one"
    return [Row("f", what, float(done == list(range(8))), 1.0, 1.0, "", at_least=True)]
