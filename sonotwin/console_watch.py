"""A step's lines and its progress on the console."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress

from recon.session.watch import Thing, Watch


class ConsoleWatch(Watch):
    """Shows the lines as they are; progress, on a terminal, for as long as the work takes."""

    def __init__(self) -> None:
        self.console = Console(soft_wrap=True, highlight=False)

    def say(self, line: str) -> None:
        """Print a line."""
        self.console.print(line, markup=False)

    def announce(self, line: str) -> None:
        """Print a line that stands out."""
        self.console.print(line, style="bold cyan", markup=False)

    def warn(self, line: str) -> None:
        """Print a line where errors stand."""
        print(f"sonotwin: {line}", file=sys.stderr)

    @contextmanager
    def busy(self, does: str) -> Iterator[None]:
        """Show that something is being done."""
        with self.console.status(does):
            yield

    def follow(self, things: Iterable[Thing], total: int, does: str) -> Iterator[Thing]:
        """Show a bar."""
        with Progress(console=self.console, transient=True, disable=not self.console.is_terminal) as progress:
            yield from progress.track(things, total=total, description=does)
