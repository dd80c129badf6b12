"""Ctrl-C, and the signals by which the system ends a process, held back while something must not be left half done."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP


@contextmanager
def held_back() -> Iterator[list[int]]:
    """Give a list that gets the number of each signal that comes; in the end, the first is let through, as if it came then."""
    came = list[int]()
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        yield came
        return
    handlers = {number: signal.getsignal(number) for name in NAMES if (number := getattr(signal, name, None)) is not None}
    kept = {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}
    for number in kept:
        signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield came
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
