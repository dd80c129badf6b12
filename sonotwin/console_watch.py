"""The console of verbs, and a step's lines and progress on it."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress

from recon.session.watch import Thing, Watch


class LineConsole(Console):
    """Prints lines as they are. It falls silent when its reader goes away, such as `head`, and the work goes on.

    What couldn't be written stays in the buffer of stdout, so that the command's last flush finds the broken pipe for its status.
    """

    def __init__(self) -> None:
        super().__init__(soft_wrap=True, highlight=False, emoji=False)

    def on_broken_pipe(self) -> None:
        """Say nothing more, in place of ending the process."""
        self.quiet = True


class ConsoleWatch(Watch):
    """Shows the lines as they are; progress, on a terminal, for as long as the work takes."""

    def __init__(self) -> None:
        self.console = LineConsole()

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
