"""The whole demonstration, from nothing rendered to the report: as in a fresh clone, then with code that is compiled."""

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from recon.files import metrics
from recon.files.metrics import Metrics
from sonotwin.demonstration import RESULT
from twin.experiments.table_rows import Measurement, Row


def measurements() -> list[Measurement]:
    """The rows of the group."""
    return [whole]


def whole() -> list[Row]:
    """The budgets of `make demo`, and its longest step: the calibration board, which is rendered once and kept."""
    with TemporaryDirectory() as folder:
        caches = {"SONOTWIN_CACHE": folder, "HOME": folder}  # DrJit keeps its own at home
        fresh, _ = demonstration(Path(folder) / "first", caches)
        compiled, figures = demonstration(Path(folder) / "second", caches)
    name = "board, surface and filmed sweeps, rendered, measured and compared"
    return [
        Row("demo", f"{name}, nothing compiled before", fresh, 300, None, "s"),
        Row("demo", name, compiled, 210, None, "s"),
        Row("demo", "of that, the board rendered in 10 poses", figures["seconds_board"], 45, None, "s"),
        Row("demo", "of that, found and decoded in them", figures["seconds_detect"], 12, None, "s"),
    ]


def demonstration(out: Path, environment: dict[str, str]) -> tuple[float, Metrics]:
    """Run it in a process of its own; returns the seconds, those of the start included, and the figures."""
    command = [sys.executable, "-m", "sonotwin", "demo", f"out={out}", f"board={out.with_name(out.name + '_board')}"]
    start = perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=os.environ | environment)
    seconds = perf_counter() - start
    return seconds, metrics.read(out / metrics.FILE) | metrics.read(out / RESULT / "optics" / metrics.FILE)
