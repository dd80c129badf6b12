"""Measure the errors of the twin and of the pipeline, beside what is asked, what physics allows and what the paper reports.

Reads the rig from conf/. Writes outputs/accuracy/GROUP.json, a list of {id, what, measured, bar, limit, unit, ok, seconds}, and
refreshes the tables in docs/accuracy.md where the command runs in a clone. Takes some minutes a group. Exit status 2 if a bar
is missed.

    sonotwin accuracy only=optics
"""

from importlib import import_module
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict
from rich.console import Console

from recon.errors import InputError
from recon.rig import Rig
from twin.accuracy import rows

GROUPS = ("optics", "surface")
DOCUMENT = Path("docs/accuracy.md")


class Config(BaseModel):
    """Fields of `conf/accuracy.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: Rig
    only: Literal["optics", "surface"] | None
    out: Path


def run(config: Config) -> None:
    """Measure, print, write; complain of bars that are missed.

    Raises
    ------
    InputError
        If a bar is missed.
    """
    console = Console(soft_wrap=True, highlight=False)
    missed = []
    for group in [config.only] if config.only else GROUPS:
        measured = []
        for row in rows.measure(import_module(f"twin.accuracy.{group}").measurements(config.rig)):
            verdict = "ok  " if row.ok else "MISS"
            console.print(f"{verdict} {row.id:3}{row.what}: {row.measured:.4g} {row.unit} (bar {row.bar:.4g})", markup=False)
            measured.append(row)
        rows.write(config.out / f"{group}.json", measured)
        if DOCUMENT.is_file():
            rows.refresh(DOCUMENT, group, rows.table(measured, "limit"))
        console.print(f"wrote {config.out / f'{group}.json'}", markup=False)
        missed += [f"{group} {row.id}" for row in measured if not row.ok]
    if missed:
        raise InputError(f"accuracy: expected every bar to be met, found {len(missed)} missed: {', '.join(missed)}")
