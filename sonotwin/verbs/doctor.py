"""Check this installation: what works, what does not, and what to do about it.

Reads nothing and writes nothing but a small file in the user's cache folder, which remembers the verdict on an LLVM that had
to be tried. Takes some seconds. Exit status 0 if the core can be used, else 2; the twin and the training may be missing.

    sonotwin doctor
"""

import textwrap

from recon.errors import InputError
from recon.model.rig import Part
from sonotwin import installation
from sonotwin.console_watch import LineConsole

STYLES = {"ok": "green", "absent": "yellow", "unused": "dim", "problem": "bold red"}
WHAT = 18  # characters of the second column
INDENT = 8 + WHAT + 9  # of the findings
NARROWEST = 100  # characters a line, also where no terminal says


class Config(Part):
    """The verb takes no fields."""


def run(config: Config) -> None:
    """Print the findings, then what to do about each problem.

    Raises
    ------
    InputError
        If the core can't be used.
    """
    findings = installation.examine()
    console = LineConsole()
    for finding in findings:
        console.print(f"{finding.part:8}{finding.what:{WHAT - 1}} ", end="")
        console.print(f"{finding.state:9}", style=STYLES[finding.state], end="")
        room = max(console.width, NARROWEST) - INDENT
        lines = textwrap.wrap(finding.found, room, break_long_words=False, break_on_hyphens=False)
        console.print(f"\n{' ' * INDENT}".join(lines), markup=False)
    for finding in findings:
        if finding.remedy:
            console.print(f"{finding.part} {finding.what}: {finding.remedy}", markup=False)
    broken = [finding.what for finding in findings if finding.part == "core" and finding.state == "problem"]
    if broken:
        raise InputError(f"doctor: the core can't be used, because of {', '.join(broken)}")
