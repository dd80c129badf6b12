"""Measure the groups of conf/bars/benchmark, print them and write them to outputs/benchmark and docs/benchmarks.md."""

import sys
from dataclasses import replace
from pathlib import Path

from sonotwin.choices import read_rig
from sonotwin.config import folder
from sonotwin.verbs.accuracy import setup_of
from twin.engine import Engine
from twin.experiments import bars, document_tables, result_rows

GROUPS = ("optics", "surface", "calibration", "ultrasound", "tracking", "studies", "live", "demo")
DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "benchmarks.md"
OUT = Path("outputs/benchmark")


def main(groups: list[str]) -> int:
    """Run the groups that are named, or all; 2 for a group that doesn't exist, 1 if a bar is missed."""
    unknown = [group for group in groups if group not in GROUPS]
    if unknown:
        print(f"benchmarks: {unknown[0]}: expected one of {', '.join(GROUPS)}", file=sys.stderr)
        return 2
    OUT.mkdir(parents=True, exist_ok=True)
    setup, met = setup_of(read_rig("meza2021")), True
    day, commit = document_tables.state(DOCUMENT.parent)
    for group in groups or GROUPS:
        entries = bars.read(folder() / "bars" / "benchmark" / f"{group}.yaml")
        measured = [replace(row, day=day, commit=commit) for row in bars.measure(entries, setup, None, Engine())]
        result_rows.write_table(OUT / result_rows.TABLE, group, measured)
        text = result_rows.whole_table(measured, "peer")
        document_tables.refresh(DOCUMENT, group, text)
        print(f"\n{group}\n{text}")
        met &= all(row.met is not False for row in measured)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
