"""Tasks are done by any engine to the same results; a worker that dies costs the task that it was at."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path

import pytest

from recon.errors import InputError
from tests.patience import PATIENCE_S
from twin.engine import Engine, results

ENGINES = {
    "this process": Engine(),
    "two processes": Engine(workers=2, recycle=3),
    "dask": Engine(name="dask", workers=2),
}


def square(k: int) -> tuple[int, int, int]:
    return k, k * k, os.getpid()


def threads(_: int) -> tuple[int, str | None]:
    import numba

    return numba.config.NUMBA_NUM_THREADS, os.environ.get("OPENBLAS_NUM_THREADS")


def dies_once(k: int, folder: str) -> int:
    """The third task's process is killed, the first time."""
    mark = Path(folder) / str(k)
    tried = mark.exists()
    mark.write_text("begun")
    if k == 2 and not tried:
        os.kill(os.getpid(), signal.SIGKILL)
    return k


def dies(k: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def refuses(k: int) -> int:
    if k == 3:
        raise InputError("a field: expected this, found that")
    return k


@pytest.fixture(params=["this process", "two processes", pytest.param("dask", marks=pytest.mark.slow)], scope="module")
def engine(request) -> Iterator[Engine]:
    """Dask's workers are there already, as on other machines: the tests below start their own."""
    if ENGINES[request.param].name != "dask":
        yield ENGINES[request.param]
        return
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster:
        yield Engine(name="dask", scheduler=cluster.scheduler_address)


def test_every_task_is_done_once_and_processes_are_replaced_after_their_share(engine):
    done = list(results(engine, square, ((k,) for k in range(7))))
    assert sorted(one[:2] for one in done) == [(k, k * k) for k in range(7)]
    used = [process for *_, process in done]
    if engine == ENGINES["two processes"]:
        assert len(set(used)) >= 3 and max(used.count(one) for one in used) <= 3
    assert (os.getpid() in used) == (engine == ENGINES["this process"])


def test_no_tasks_are_no_work(engine):
    assert list(results(engine, square, [])) == []


def test_an_error_of_a_task_is_the_callers(engine):
    with pytest.raises(InputError, match="a field: expected this"):
        list(results(engine, refuses, ((k,) for k in range(6))))


def test_tasks_are_taken_as_they_are_needed(engine):
    """An endless stream of tasks: some results are given, and few tasks more are taken than those."""
    taken = []
    tasks = ((taken.append(k) or k,) for k in count())
    assert len(list(islice(results(engine, square, tasks), 5))) == 5
    assert len(taken) <= 5 + 8


@pytest.mark.parametrize("name", ["two processes", "dask"])
def test_a_dead_worker_costs_its_task(tmp_path, name):
    if name == "dask":
        pytest.importorskip("distributed")
    done = list(results(ENGINES[name], dies_once, ((k, str(tmp_path)) for k in range(4))))
    assert sorted(done) == list(range(4))


@pytest.mark.parametrize("name", ["two processes", pytest.param("dask", marks=pytest.mark.slow)])
def test_a_task_that_kills_its_workers_is_given_up(name):
    if name == "dask":
        pytest.importorskip("distributed")
    few = ENGINES[name].model_copy(update={"retries": 1})
    with pytest.raises(InputError, match="died 2 times, likely for want of memory"):
        list(results(few, dies, [(1,)]))


def test_workers_share_the_cores_and_leave_the_environment_alone():
    before = dict(os.environ)
    share = max((os.cpu_count() or 1) // 2, 1)
    assert set(results(Engine(workers=2), threads, [(1,), (2,)])) == {(share, "1")}
    assert dict(os.environ) == before


def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    program = f"""
import os, time
from tests.twin.test_engine import sleeps
from twin.engine import Engine, results
if __name__ == "__main__":
    list(results(Engine(workers=2), sleeps, [({str(tmp_path)!r}, k) for k in range(2)]))
"""
    script = tmp_path / "program.py"
    script.write_text(program)
    root = Path(__file__).resolve().parents[2]
    parent = subprocess.Popen([sys.executable, str(script)], cwd=root, env={**os.environ, "PYTHONPATH": str(root)})
    marks = [tmp_path / f"pid{k}" for k in range(2)]
    wait_until(lambda: all(mark.exists() and mark.read_text() for mark in marks))
    parent.kill()
    parent.wait()
    wait_until(lambda: not any(alive(int(mark.read_text())) for mark in marks))


def sleeps(folder: str, k: int) -> None:
    (Path(folder) / f"pid{k}").write_text(str(os.getpid()))
    time.sleep(600)


def alive(process: int) -> bool:
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"


def wait_until(true, seconds: float = PATIENCE_S) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def test_a_run_that_is_stopped_leaves_no_process(tmp_path):
    """Closed after its first result, while the other worker is at a task of ten minutes."""
    running = results(Engine(workers=2), sleeps_but_once, [(str(tmp_path), k) for k in range(3)])
    assert next(running) == 1
    started = time.monotonic()
    running.close()
    assert time.monotonic() - started < 500
    wait_until(lambda: not any(alive(int(mark.read_text())) for mark in tmp_path.glob("pid*")))


def sleeps_but_once(folder: str, k: int) -> int:
    (Path(folder) / f"pid{k}").write_text(str(os.getpid()))
    if k != 1:
        time.sleep(600)
    return k


def test_a_scheduler_belongs_to_dask():
    with pytest.raises(ValueError, match=r"scheduler: expected engine.name=dask with it, found local"):
        Engine(scheduler="tcp://host:8786")


def test_a_scheduler_that_is_not_there_is_named():
    pytest.importorskip("distributed")
    import dask

    with (
        dask.config.set({"distributed.comm.timeouts.connect": "0.5s"}),
        pytest.raises(
            InputError,
            match=r"engine\.scheduler: expected the address of Dask's scheduler with a worker, found none at tcp://127\.0\.0\.1:1:",
        ),
    ):
        list(results(Engine(name="dask", scheduler="tcp://127.0.0.1:1"), square, [(1,)]))


def test_a_scheduler_without_workers_is_named(monkeypatch):
    """It is given a time to have one; then nobody waits for tasks that nobody does."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("twin.engine.FIRST_WORKER_S", 0.2)
    with distributed.LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0") as idle:
        address = idle.scheduler_address
        with pytest.raises(InputError, match=f"Dask's scheduler with a worker, found none at {address}"):
            list(results(Engine(name="dask", scheduler=address), square, [(1,)]))
