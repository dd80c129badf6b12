"""Independent tasks on workers: processes of this machine, or Dask's, here or on other machines.

A task is a call of a function whose result depends on the arguments alone, so it may be done anywhere, in any order, and again.
Tasks are handed out one by one as workers get free: a worker that dies costs the task that it was at, which another one does.
"""

import logging
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from itertools import islice
from multiprocessing import active_children, connection, get_context, parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, model_validator

from recon.errors import InputError
from recon.model.part import Part

Result = TypeVar("Result")
Work = Callable[..., Result]
Task = tuple[Any, ...]  # arguments of the work

THREADS = ("SONOTWIN_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS")  # whose results are the same from any number
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # of linear algebra, whose sums are not
FIRST_WORKER_S = 60.0  # that a scheduler is given to have a worker
AHEAD = 2  # tasks a thread of Dask's, so that none waits for the next one


class Engine(Part):
    """Where tasks are done, see `conf/engine`. On machines of one kind none of it changes a result."""

    name: Literal["local", "dask"] = "local"
    workers: Annotated[int, Field(ge=1, le=1024)] = 1  # processes; 1 of local is this process itself
    scheduler: str | None = None  # address of Dask's scheduler, tcp://host:8786; if not given, one is started here
    recycle: Annotated[int, Field(ge=1)] = 200  # tasks after which a local worker is replaced, whatever memory it has lost
    retries: Annotated[int, Field(ge=0, le=100)] = 3  # of a task whose worker has died; a scheduler that is given has its own

    @model_validator(mode="after")
    def _one_place(self) -> "Engine":
        if self.scheduler is not None and self.name != "dask":
            raise ValueError(f"scheduler: expected engine.name=dask with it, found {self.name}")
        return self


def results(engine: Engine, work: Work[Result], tasks: Iterable[Task]) -> Iterator[Result]:
    """Do tasks, and give their results as they are ready, in any order.

    Parameters
    ----------
    work : function of a module, so that workers find it by its name
    tasks : taken one by one, a few ahead of the results' use

    Raises
    ------
    InputError
        If a task's worker has died more often than `engine.retries`, or Dask can't be reached.
    """
    if engine.name == "dask":
        return _by_dask(engine, work, tasks)
    if engine.workers == 1:
        return (work(*task) for task in tasks)
    return _by_processes(engine, work, tasks)


class _Worker:
    """A process that does one task at a time, and is replaced when it has died or done its share."""

    def __init__(self, engine: Engine) -> None:
        self.share, self.threads = engine.recycle, max((os.cpu_count() or 1) // engine.workers, 1)
        self.begun, self.pool = 0, _pool()
        self.processes: set[BaseProcess] = set()

    def begin(self, work: Work[Result], task: Task) -> Future[Result]:
        """Begin a task."""
        if self.begun == self.share:
            self.replace()
        try:
            return self._submit(work, task)
        except BrokenProcessPool:  # it died while it was idle
            self.replace()
            return self._submit(work, task)

    def replace(self) -> None:
        """Begin anew with another process."""
        self.pool.shutdown()
        self.begun, self.pool = 0, _pool()

    def end(self, at_once: bool) -> None:
        """End the process; at once if nobody waits for its task."""
        for process in self.processes if at_once else ():
            process.terminate()
        self.pool.shutdown(cancel_futures=True)

    def _submit(self, work: Work[Result], task: Task) -> Future[Result]:
        self.begun += 1
        if self.begun > 1:
            return self.pool.submit(work, *task)
        others = set(active_children())
        with _threads(self.threads):  # in the environment of the process that begins now
            future = self.pool.submit(work, *task)
        self.processes = set(active_children()) - others
        return future


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_depend_on_parent)


def _depend_on_parent() -> None:
    """End this process with its parent, which takes Ctrl-C for both; else it would go on after the parent was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if (parent := parent_process()) is not None:
        Thread(target=_end_after, args=(parent.sentinel,), daemon=True).start()


def _end_after(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


def _by_processes(engine: Engine, work: Work[Result], tasks: Iterable[Task]) -> Iterator[Result]:
    """Do tasks in processes of this machine."""
    waiting, again = iter(tasks), deque[tuple[Task, int]]()  # tasks, and how often their worker has died
    workers = [_Worker(engine) for _ in range(engine.workers)]
    running: dict[Future[Result], tuple[_Worker, Task, int]] = {}
    idle = list(workers)
    try:
        while True:
            while idle and (following := _next(again, waiting)):
                worker, (task, deaths) = idle[-1], following
                running[worker.begin(work, task)] = worker, task, deaths
                idle.pop()
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            ready = []
            for future in done:
                worker, task, deaths = running.pop(future)
                idle.append(worker)
                if isinstance(future.exception(), BrokenProcessPool):
                    worker.replace()
                    again.append((task, _counted(engine, deaths)))
                else:
                    ready.append(future)
            for future in sorted(ready, key=lambda future: future.exception() is not None):  # an error ends it all
                yield future.result()
    finally:
        for worker in workers:
            worker.end(at_once=bool(running))


def _next(again: deque[tuple[Task, int]], waiting: Iterator[Task]) -> tuple[Task, int] | None:
    """The next task: one whose worker has died, else a new one."""
    if again:
        return again.popleft()
    return next(((task, 0) for task in waiting), None)


def _counted(engine: Engine, deaths: int) -> int:
    """One death more of a task's workers; an error if it was one too many."""
    if deaths == engine.retries:
        times = f"{deaths + 1} times" if deaths else "once"
        raise InputError(
            f"engine: a task's process died {times}, likely for want of memory; try engine.workers={engine.workers // 2 or 1}"
        )
    return deaths + 1


def _by_dask(engine: Engine, work: Work[Result], tasks: Iterable[Task]) -> Iterator[Result]:
    """Do tasks by Dask's workers."""
    from distributed import as_completed

    waiting = iter(tasks)
    with _client(engine) as client:

        def begin(count: int) -> list:
            return [client.submit(work, *task, pure=False) for task in islice(waiting, count)]

        running = as_completed(begin(_places(client)))
        for future in running:
            result = future.result()
            future.release()
            room = _places(client) - running.count()
            for begun in begin(max(room, 1)):
                running.add(begun)
            yield result


def _places(client: Any) -> int:
    """Tasks that may be under way, for as many workers as there are now."""
    return AHEAD * max(sum(client.nthreads().values()), 1)


@contextmanager
def _client(engine: Engine) -> Iterator[Any]:
    """Dask's scheduler: the one that is given, or one with workers on this machine."""
    import dask
    from distributed import Client, KilledWorker, LocalCluster

    with ExitStack() as stack:
        if engine.scheduler is None:
            stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": engine.retries}))
            stack.enter_context(_threads(max((os.cpu_count() or 1) // engine.workers, 1)))
            here = {"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
            with _no_interrupts():
                local = LocalCluster(engine.workers, threads_per_worker=1, **here)
            client = stack.enter_context(Client(stack.enter_context(local)))
        else:
            try:
                client = stack.enter_context(Client(engine.scheduler))
                client.wait_for_workers(1, timeout=FIRST_WORKER_S)
            except (OSError, TimeoutError, ValueError) as error:
                expected = f"expected the address of Dask's scheduler with a worker, found none at {engine.scheduler}"
                raise InputError(f"engine.scheduler: {expected}: {error}") from None
        try:
            yield client
        except KeyboardInterrupt:
            if engine.scheduler is None:
                _end_at_once()
            raise
        except KilledWorker as error:
            reason = "likely for want of memory; start Dask with fewer workers a machine"
            raise InputError(f"engine: a task's worker died {error.allowed_failures + 1} times, {reason}") from None


def _end_at_once() -> None:
    """End all workers of this machine, whose tasks nobody waits for any more; what Dask would say of it isn't said."""
    for name in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
        logging.getLogger(name).disabled = True
    for worker in active_children():
        worker.kill()


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Hold Ctrl-C back; threads and processes that are begun meanwhile never get it, as this process ends them all."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # which lets Ctrl-C through again when it begins
    kept = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, kept)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Give processes that are begun meanwhile so many threads each."""
    kept = {name: os.environ.get(name) for name in (*THREADS, *ONE_THREAD)}
    os.environ |= dict.fromkeys(THREADS, str(count)) | dict.fromkeys(ONE_THREAD, "1")
    try:
        yield
    finally:
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
