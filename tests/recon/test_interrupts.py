"""Signals that come while they are held back, and what they do then."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from recon import interrupts


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_let_through_in_the_end(number):
    """Once, by the handler of before, though it came twice."""
    before, done = signal.signal(number, signal.default_int_handler), []
    try:
        with pytest.raises(KeyboardInterrupt), interrupts.held_back() as came:
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)
            done.append(list(came))
        assert done == [[number, number]] and signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, before)


def test_ignored_signals_stay_ignored():
    """Such as SIGHUP under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts.held_back() as came:
            os.kill(os.getpid(), signal.SIGHUP)
        assert came == []
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_process_without_a_handler_ends_by_the_signal():
    program = """
import os, signal
from recon import interrupts
with interrupts.held_back():
    os.kill(os.getpid(), signal.SIGTERM)
    print("whole", flush=True)
print("beyond")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGTERM and done.stdout == "whole\n"


def test_other_threads_hold_nothing_back():
    """They never get signals."""
    seen = []

    def work():
        with interrupts.held_back() as came:
            seen.append(list(came))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [[]]
