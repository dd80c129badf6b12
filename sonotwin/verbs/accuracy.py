"""Measure the errors of the twin and of the pipeline, beside their bars, the limits of physics and the paper's figures.

Reads the rig and the pattern sequences from conf/, and real recordings where `real` names their folder. Writes GROUP.json into
the folder `out`, a list of {id, what, measured, bar, limit, unit, ok, seconds}, and figures. With `document=docs/accuracy.md` the
group's rows are replaced in docs/accuracy.csv, with day and commit, and the page's table is made of all rows there by
conf/bars/accuracy.yaml. Takes some minutes a group, and about an hour for tracking, for which a thousand pairs of frames are
rendered, an hour for studies and three hours for sessions. Exit status 1 if a bar is missed.

    sonotwin accuracy only=optics
"""

from importlib import import_module
from pathlib import Path
from typing import Literal, get_args

import yaml
from rich.console import Console

from recon.capture.surface_part import read_patterns
from recon.errors import InputError
from recon.model.rig import Part, Rig
from sonotwin.config import folder
from twin.conditions import Conditions
from twin.experiments import kept_rows, table_rows
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound.transducer import Transducer

Group = Literal[
    "optics", "surface", "reality", "calibration", "scale", "lifelike", "ultrasound", "tracking", "session", "studies",
    "strangers", "trust", "live",
]  # fmt: skip
MODULES = {
    "session": "sonotwin.session_accuracy",
    "studies": "sonotwin.study_accuracy",
    "live": "sonotwin.live_accuracy",
}  # of the others twin.experiments.GROUP_accuracy


class Config(Part):
    """Fields of `conf/accuracy.yaml`."""

    rig: Rig
    only: Group | None
    out: Path
    document: Path | None
    real: Path | None


def run(config: Config) -> int:
    """Measure, print and write; returns 1 if a bar is missed.

    Raises
    ------
    InputError
        If a place to write to, or the real recordings, are not there.
    """
    groups = [config.only] if config.only else get_args(Group)
    if config.document:
        table_rows.check_place(config.document, kept_rows.MARK)
        kept_rows.read(kept_rows.file_of(config.document))
    shown = choices() if config.document else []  # as they are before hours of work
    if config.real and not config.real.is_dir():
        raise InputError(f"accuracy: real: expected a folder of recordings, found none at {config.real}")
    config.out.mkdir(parents=True, exist_ok=True)
    setup = setup_of(config.rig, config.real, config.out)
    console = Console(soft_wrap=True, highlight=False)
    met = True
    for group in groups:
        measured = []
        for row in table_rows.measure(
            import_module(MODULES.get(group, f"twin.experiments.{group}_accuracy")).measurements(setup)
        ):
            verdict = "    " if row.bar is None else "ok  " if row.ok else "MISS"
            asked = "" if row.bar is None else f" (bar {row.bar:.4g})"
            console.print(f"{verdict} {row.id:3}{row.what}: {row.measured:.4g} {row.unit}{asked}", markup=False)
            measured.append(row)
        table_rows.write(config.out / f"{group}.json", measured)
        if config.document:
            kept_rows.enter(config.document, shown, group, measured)
        console.print(f"wrote {config.out / f'{group}.json'}", markup=False)
        met &= all(row.ok for row in measured)
    return 0 if met else 1


def choices() -> list[kept_rows.Chosen]:
    """Rows of the document's table, as conf/bars/accuracy.yaml has them."""
    return kept_rows.read_choices(folder() / "bars" / "accuracy.yaml")


def setup_of(rig: Rig, real: Path | None = None, out: Path | None = None) -> table_rows.Setup:
    """Inputs of the measurements: a rig, all sequences and scanners of conf/, and real recordings if they are at hand."""
    sequences = {path.stem: read_patterns(path) for path in (folder() / "patterns").glob("*.yaml")}
    scanners = {
        path.stem: Transducer(**yaml.safe_load(path.read_text(encoding="utf-8")))
        for path in (folder() / "ultrasound").glob("*.yaml")
    }
    frames = DataRanges(**yaml.safe_load((folder() / "dataset.yaml").read_text(encoding="utf-8"))["ranges"])
    lifelike = Conditions(**yaml.safe_load((folder() / "conditions" / "lifelike.yaml").read_text(encoding="utf-8")))
    return table_rows.Setup(rig, sequences, real, scanners, frames, out, lifelike)
