"""Commands in copies of one process that has imported the verbs: as in new processes, less the seconds that the imports take."""

import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import NamedTuple

from campaign import commands
from campaign.commands import Kill, Outcome, Run

LOOK_S = 0.01  # between two looks whether a copy has ended
NOT_YET = ("train",)  # torch takes as long as all else together, and its threads would not be in a copy


class Copies(NamedTuple):
    """What runs and kills one command at a time, as `commands.run` and `commands.kill`."""

    run: Run
    kill: Kill


@contextmanager
def copies() -> Iterator[Copies]:
    """What runs commands, as long as the process that is copied lives."""
    line = [sys.executable, "-m", __name__]
    quiet = {"OPENCV_LOG_LEVEL": "SILENT"}  # as the command line sets it, but OpenCV is already loaded then
    with subprocess.Popen(
        line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=commands.environment() | quiet, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"

        def ask(arguments: Sequence[str], folder: Path, said: str, number: int, after_s: float) -> list[float]:
            assert process.stdin is not None and process.stdout is not None
            print(json.dumps([arguments, str(folder), said, number, after_s]), file=process.stdin, flush=True)
            return json.loads(process.stdout.readline())

        def run(arguments: Sequence[str], folder: Path, longest_s: float) -> Outcome:
            before, start = commands.snapshot(folder), time.perf_counter()
            with NamedTemporaryFile() as said:
                _, status, peak_mb, _ = ask(arguments, folder, said.name, signal.SIGKILL, longest_s)
                seconds, text = time.perf_counter() - start, said.read().decode(errors="backslashreplace")
            return Outcome(int(status), text, seconds, peak_mb, commands.changes(before, commands.snapshot(folder)))

        def kill(arguments: Sequence[str], folder: Path, number: int, after_s: float) -> tuple[int, bool]:
            session, _, _, ended = ask(arguments, folder, os.devnull, number, after_s)
            return int(session), bool(ended)

        yield Copies(run, kill)


def main() -> int:
    """Copy this process for each command on stdin, and send the copy a signal after some seconds if it hasn't ended.

    Answers with its session, status and memory, and whether it ended by itself; returns a command's status in a copy.
    """
    from sonotwin import __main__, cli, config

    composed = set[str]()

    for verb in cli.VERBS:
        if verb.name not in NOT_YET:
            import_module(verb.module)
    print("ready", flush=True)
    for line in sys.stdin:
        arguments, folder, said, number, after_s = json.loads(line)
        verb = next(iter(arguments), "")
        if verb in {each.name for each in cli.VERBS} - composed:
            config.defaults(verb)  # Hydra takes its time; what it composed is in all copies
            composed.add(verb)
        child = os.fork()
        if not child:
            os.setsid()
            os.chdir(folder)
            nothing, told = os.open(os.devnull, os.O_RDWR), os.open(said, os.O_WRONLY)
            for stream, instead in enumerate((nothing, nothing, told)):
                os.dup2(instead, stream)
            sys.argv = ["sonotwin", *arguments]
            os._exit(_ended(__main__.main))  # at once: libraries would wait for their threads, which a copy doesn't have
        until, by_itself = time.perf_counter() + after_s, True
        while not (found := os.wait4(child, os.WNOHANG))[0]:
            if by_itself and time.perf_counter() > until:
                os.kill(child, number)
                by_itself = False
            time.sleep(LOOK_S)
        _, ended, used = found
        status = os.waitstatus_to_exitcode(ended)
        print(json.dumps([child, status if status >= 0 else 128 - status, used.ru_maxrss / 1024, by_itself]), flush=True)
    return 0


def _ended(command: Callable[[], int]) -> int:
    """The status with which a process of its own would end."""
    try:
        status = command()
    except BaseException:  # noqa: BLE001 - as the interpreter does, with a traceback
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return status


if __name__ == "__main__":
    sys.exit(main())
