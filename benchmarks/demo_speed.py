"""The whole demonstration, from nothing rendered to the report, with code that is compiled."""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from recon.files import metrics
from twin.accuracy.table_rows import Measurement, Row


def measurements() -> list[Measurement]:
    """The rows of the group."""
    return [whole]


def whole() -> list[Row]:
    """The budget of `make demo`, and its longest step: the calibration board, which is rendered once and kept."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "demo"
        subprocess.run(
            [sys.executable, "-m", "sonotwin", "demo", f"out={out}", f"board={Path(folder) / 'board'}"],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        figures = metrics.read(out / metrics.FILE)
    return [
        Row("demo", "board, surface, sweep and film, rendered, measured and compared", figures["seconds_demo"], 300, None, "s"),
        Row("demo", "of that, the board in 10 poses", figures["seconds_board"], None, None, "s"),
    ]
