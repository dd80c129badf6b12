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
from typing import Literal

import numpy as np
import psutil

from twin.engine import Engine, results
from twin.experiments.experiment_setup import Figures, Setup

WORKERS = 2
LONG_S, LONG = 10.0, 12  # tasks of ten seconds
SHORT = 10_000
Name = Literal["local", "dask"]


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


def long_tasks(setup: Setup, engine: Name) -> Figures:
    """Time beyond the tasks' own, from the first result to the last: the start of the workers is apart."""
    moments = [time.perf_counter()]
    for _ in results(Engine(name=engine, workers=WORKERS), rest, ((k,) for k in range(LONG + WORKERS))):
        moments.append(time.perf_counter())
    own = LONG / WORKERS * LONG_S
    figures = {"tasks": LONG, "workers": WORKERS, "over_percent": 100 * ((moments[-1] - moments[WORKERS]) / own - 1)}
    peer = {"peer_percent": 100 * (_by_a_plain_pool() / own - 1)} if engine == "local" else {}
    return figures | peer | {"start_s": moments[1] - moments[0] - LONG_S}


def _by_a_plain_pool() -> float:
    """Seconds that the standard library's pool takes, once its processes have begun."""
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        list(pool.map(rest, range(WORKERS)))
        start = time.perf_counter()
        list(pool.map(rest, range(LONG)))
        return time.perf_counter() - start


def short_tasks(setup: Setup, engine: Name) -> Figures:
    """Rates of the tenths of many short tasks, and the growth of this process's memory."""
    process, moments, memory = psutil.Process(), [time.perf_counter()], []
    for done, _ in zip(count(1), results(Engine(name=engine, workers=WORKERS), square, _numbers()), strict=False):
        if done % (SHORT // 10) == 0:
            moments.append(time.perf_counter())
            memory.append(process.memory_info().rss / 1e6)
    seconds = np.diff(moments)[1:]  # the first tenth has the workers' start in it
    rates = {"rate_hz": SHORT / 10 / np.median(seconds), "slowest": seconds.max() / seconds.min()}
    return rates | {"tasks": SHORT, "growth_mb": memory[-1] - memory[1]}


def _numbers() -> Iterator[tuple[int]]:
    return ((k,) for k in range(SHORT))


def killed(setup: Setup, engine: Name) -> Figures:
    """Tasks that are begun again because a worker is killed in the middle."""
    with TemporaryDirectory() as folder:
        tasks = ((k, folder) for k in range(8))
        return {"right": sorted(results(Engine(name=engine, workers=WORKERS), rest_or_die, tasks)) == list(range(8))}
