"""Render a round of the open benchmark: sessions for others to work on, and apart from them the sealed truth.

Writes OUT/sessions/NUMBER-TASK/, a session each of optics, tracking, surface, ultrasound in turn: images as PNG, tables as CSV,
session.json; OUT/truth/, which only `sonotwin score-benchmark` opens; OUT/benchmark.json with the seed's SHA-256 and those of the
truth; OUT/checksums.sha256. The seed is a text: a public one for practice, a secret one for a sealed round. The same seed
gives the same bytes, whatever the workers. Takes some 10 to 60 s of one core a session. A run that was
stopped goes on where it was when started again, also with more sessions. See docs/benchmark.md.

    sonotwin render-benchmark out=outputs/practice sessions=8
    sonotwin render-benchmark out=outputs/round sessions=200 seed="a long secret sentence" engine.workers=2
"""

from pathlib import Path
from time import perf_counter
from typing import Annotated

from pydantic import Field
from rich.progress import Progress

from recon.files.occupied import occupied
from recon.model.rig import Part
from recon.registry import Choice
from sonotwin.console_watch import LineConsole
from twin.engine import Engine, results


class Config(Part):
    """Fields of `sonotwin render-benchmark`."""

    engine: Annotated[Engine, Choice("local")]
    """where sessions are rendered: local or dask; doesn't change a byte"""
    out: Path
    """folder; gets sessions/, truth/, benchmark.json and checksums.sha256"""
    sessions: Annotated[int, Field(ge=1, le=1_000_000)] = 200
    """number of sessions, of the four tasks in turn"""
    seed: Annotated[str, Field(min_length=1, max_length=1000)] = "practice"
    """text from which all is drawn; its SHA-256 is published. A secret one has 20 random letters or more"""


def run(config: Config) -> None:
    """Render the sessions that are missing; InputError if `out` holds another round or something else."""
    from sonotwin import benchmark_sessions  # brings the renderer, which --help can do without

    console, out, start = LineConsole(), config.out, perf_counter()
    with occupied(out):
        numbers = benchmark_sessions.missing(out, config.seed, config.sessions)
        if len(numbers) < config.sessions:
            console.print(f"found       {config.sessions - len(numbers)} sessions")
        tasks = ((out, config.seed, number) for number in numbers)
        made = results(config.engine, benchmark_sessions.write, tasks)
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            for _ in progress.track(made, total=len(numbers), description="rendering sessions"):
                pass
        benchmark_sessions.finish(out, config.seed, config.sessions)
    console.print(f"render      {len(numbers)} sessions, {perf_counter() - start:.1f} s")
    console.print(f"wrote       {out}/{{sessions,truth,benchmark.json,checksums.sha256}}", markup=False)
