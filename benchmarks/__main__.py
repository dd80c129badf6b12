"""Measure the groups, print and write `outputs/benchmark/GROUP.json`, and refresh the tables in `docs/benchmarks.md`."""

import sys
from importlib import import_module
from pathlib import Path

from twin.experiments import table_rows

GROUPS = ("optics", "surface", "calibration", "ultrasound", "tracking", "studies", "live", "demo")
DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "benchmarks.md"


def main(groups: list[str]) -> int:
    """Run the groups that are named, or all; 2 for a group that doesn't exist, 1 if a bar is missed."""
    unknown = [group for group in groups if group not in GROUPS]
    if unknown:
        print(f"benchmarks: {unknown[0]}: expected one of {', '.join(GROUPS)}", file=sys.stderr)
        return 2
    met = True
    for group in groups or GROUPS:
        measured = list(table_rows.measure(import_module(f"benchmarks.{group}_speed").measurements()))
        table_rows.write(Path("outputs/benchmark") / f"{group}.json", measured)
        text = table_rows.table(measured, "peer")
        table_rows.refresh(DOCUMENT, group, text)
        print(f"\n{group}\n{text}")
        met &= all(row.ok for row in measured)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
