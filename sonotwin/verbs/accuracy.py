"""Measure the errors of the twin and of the pipeline, beside their bars, the limits of physics and the paper's figures.

Reads the rig and the pattern sequences from conf/, what is measured and asked from conf/bars/accuracy/GROUP.yaml, and real
recordings where `real` names their folder. Writes into the folder `out` results.parquet, a row a figure with experiment,
settings, value, bar, limit, unit, day and commit, and pictures; figures of the same code and settings are kept in OUT/kept/
with the day and the commit of their measurement, from which a run goes on that was stopped; times and the like are measured
each time. With `document=docs/accuracy.md` the group's rows are replaced in docs/accuracy.csv, and the page's table is made
of all rows there by conf/bars/accuracy.yaml. What needs recordings, or a virtual screen, and has none is left out with a line
that says so, and its rows stay as they are. Takes some minutes a group, and about an hour for tracking, for which a
thousand pairs of frames are rendered, an hour for studies and three hours for sessions. Exit status 1 if a bar is missed.

    sonotwin accuracy only=optics
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import yaml

from recon.capture.surface_part import read_patterns
from recon.errors import InputError
from recon.model.rig import Part, Rig
from sonotwin.config import folder
from sonotwin.console_watch import LineConsole
from twin.conditions import Conditions
from twin.engine import Engine
from twin.experiments import bars, document_tables, result_rows
from twin.experiments.experiment_setup import Setup
from twin.experiments.kept_figures import Kept, State
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound.transducer import Transducer

Group = Literal[
    "optics", "surface", "reality", "calibration", "scale", "lifelike", "ultrasound", "tracking", "session", "studies",
    "strangers", "trust", "live", "drift", "bodies",
]  # fmt: skip


class Config(Part):
    """Fields of `conf/accuracy.yaml`."""

    rig: Rig
    only: Group | None
    out: Path
    document: Path | None
    real: Path | None
    engine: Engine = Engine()


def run(config: Config) -> int:
    """Measure, print and write; returns 1 if a bar is missed.

    Raises
    ------
    InputError
        If a place to write to, or the real recordings, are not there.
    """
    groups = [config.only] if config.only else get_args(Group)
    asked = {group: bars.read(folder() / "bars" / "accuracy" / f"{group}.yaml") for group in groups}
    if config.document:
        document_tables.check_place(config.document, result_rows.MARK)
        result_rows.read(result_rows.file_of(config.document))
    shown = choices() if config.document else []  # as they are before hours of work
    if config.real and not config.real.is_dir():
        raise InputError(f"accuracy: real: expected a folder of recordings, found none at {config.real}")
    table = config.out / result_rows.TABLE
    result_rows.read_table(table)
    kept = Kept(config.out / "kept", State(*document_tables.state((config.document or folder()).parent)))
    kept.open()
    setup = setup_of(config.rig, config.real, config.out)
    console = LineConsole()
    met = True
    for group in groups:
        measured, left_out = [], [one for one in asked[group] if one.lacks(setup)]
        for one in left_out:
            console.print(f"left out {one.of}: it needs {one.lacks(setup)}; rows of earlier runs stay", markup=False)
        for row in bars.measure(asked[group], setup, kept, config.engine):
            verdict = {None: "    ", True: "ok  ", False: "MISS"}[row.met]
            bar = "" if row.bar is None else f" (bar {row.bar:.4g})"
            console.print(f"{verdict} {row.what}: {row.measured:.4g} {row.unit}{bar}", markup=False)
            measured.append(row)

        def stays(what: str, left_out: Sequence[bars.Experiment] = left_out) -> bool:
            return any(one.gives(what) for one in left_out)

        result_rows.write_table(table, group, measured, stays)
        if config.document:
            result_rows.enter(config.document, shown, group, measured, stays)
        console.print(f"wrote {table}", markup=False)
        met &= all(row.met is not False for row in measured)
    return 0 if met else 1


def choices() -> list[result_rows.Chosen]:
    """Rows of the document's table, as conf/bars/accuracy.yaml has them."""
    return result_rows.read_choices(folder() / "bars" / "accuracy.yaml")


def setup_of(rig: Rig, real: Path | None = None, out: Path | None = None) -> Setup:
    """What experiments have at hand: a rig, all sequences and scanners of conf/, and real recordings if there are any."""
    sequences = {path.stem: read_patterns(path) for path in (folder() / "patterns").glob("*.yaml")}
    scanners = {
        path.stem: Transducer(**yaml.safe_load(path.read_text(encoding="utf-8")))
        for path in (folder() / "ultrasound").glob("*.yaml")
    }
    frames = DataRanges(**yaml.safe_load((folder() / "dataset.yaml").read_text(encoding="utf-8"))["ranges"])
    lifelike = Conditions(**yaml.safe_load((folder() / "conditions" / "lifelike.yaml").read_text(encoding="utf-8")))
    return Setup(rig, sequences, real, scanners, frames, out, lifelike)
