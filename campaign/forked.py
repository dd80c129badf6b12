"""Commands in copies of one process that has imported the verbs: as in new processes, less the seconds that the imports take."""

import json
import math
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

from campaign import commands
from campaign.commands import Outcome, Run

NOT_YET = ("train",)  # torch takes as long as all else together, and its threads would not be in a copy


@contextmanager
def copies() -> Iterator[Run]:
    """What runs one command at a time, as `commands.run`, as long as the process that is copied lives."""
    line = [sys.executable, "-m", __name__]
    quiet = {"OPENCV_LOG_LEVEL": "SILENT"}  # as the command line sets it, but OpenCV is already loaded then
    with subprocess.Popen(
        line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=commands.environment() | quiet, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"

        def run(arguments: Sequence[str], folder: Path, longest_s: float) -> Outcome:
            assert process.stdin is not None and process.stdout is not None
            before, start = commands.snapshot(folder), time.perf_counter()
            with NamedTemporaryFile() as said:
                print(json.dumps([arguments, str(folder), said.name, math.ceil(longest_s)]), file=process.stdin, flush=True)
                status, peak_mb = json.loads(process.stdout.readline())
                seconds, text = time.perf_counter() - start, said.read().decode(errors="backslashreplace")
            return Outcome(status, text, seconds, peak_mb, commands.changes(before, commands.snapshot(folder)))

        yield run


def main() -> int:
    """Copy this process for each command on stdin and answer with its status and memory; in a copy, the command's status."""
    from sonotwin import __main__, cli

    for verb in cli.VERBS:
        if verb.name not in NOT_YET:
            import_module(verb.module)
    print("ready", flush=True)
    for line in sys.stdin:
        arguments, folder, said, longest_s = json.loads(line)
        child = os.fork()
        if not child:
            os.setsid()
            os.chdir(folder)
            nothing, told = os.open(os.devnull, os.O_RDWR), os.open(said, os.O_WRONLY)
            for number, instead in enumerate((nothing, nothing, told)):
                os.dup2(instead, number)
            signal.alarm(longest_s)
            sys.argv = ["sonotwin", *arguments]
            os._exit(_ended(__main__.main))  # at once: libraries would wait for their threads, which a copy doesn't have
        _, ended, used = os.wait4(child, 0)
        status = os.waitstatus_to_exitcode(ended)
        print(json.dumps([status if status >= 0 else 128 - status, used.ru_maxrss / 1024]), flush=True)
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
