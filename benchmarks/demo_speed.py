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
from twin.experiments.experiment_setup import Figures, Setup


def whole(setup: Setup) -> Figures:
    """Seconds of `make demo`, and of its longest step: the calibration board, which is rendered once and kept."""
    with TemporaryDirectory() as folder:
        caches = {"SONOTWIN_CACHE": folder, "HOME": folder}  # DrJit keeps its own at home
        fresh, _ = demonstration(Path(folder) / "first", caches)
        compiled, figures = demonstration(Path(folder) / "second", caches)
    return {"fresh_s": fresh, "compiled_s": compiled, "board_s": figures["seconds_board"], "detect_s": figures["seconds_detect"]}


def demonstration(out: Path, environment: dict[str, str]) -> tuple[float, Metrics]:
    """Run it in a process of its own; returns the seconds, those of the start included, and the figures."""
    command = [sys.executable, "-m", "sonotwin", "demo", f"out={out}", f"board={out.with_name(out.name + '_board')}"]
    start = perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=os.environ | environment)
    seconds = perf_counter() - start
    return seconds, metrics.read(out / metrics.FILE) | metrics.read(out / RESULT / "optics" / metrics.FILE)
