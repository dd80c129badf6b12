"""The person at the terminal: what is to be done is printed, and Enter says that it has been."""

import queue
import sys
import threading

from rich.console import Console

from recon.acquisition.guidance import Answer, Step

ENDS, KEEPS, DROPS = ("e", "end", "q", "quit"), ("k", "keep"), ("d", "delete")


class TerminalOperator:
    """Reads lines of the terminal while cameras go on."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._over = False
        threading.Thread(target=self._read, daemon=True).start()

    def ask(self, step: Step) -> None:
        """Print what is to be done."""
        self._console.print(f"next        {step.text} (Enter; e ends)", markup=False)

    def answer(self) -> Answer:
        """`take` for each line, `keep` for k, `drop` for d, `end` for e or the end of the input, `wait` meanwhile."""
        if self._over:
            return "end"
        try:
            line = self._lines.get_nowait()
        except queue.Empty:
            return "wait"
        word = ENDS[0] if line is None else line.strip().lower()
        self._over = word in ENDS
        return "end" if self._over else "keep" if word in KEEPS else "drop" if word in DROPS else "take"

    def _read(self) -> None:
        for line in sys.stdin:
            self._lines.put(line)
        self._lines.put(None)
