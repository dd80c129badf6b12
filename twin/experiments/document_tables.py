"""Tables in documents: text between two marks, replaced under the date and the commit of now."""

import re
import subprocess
from datetime import UTC, datetime
from pathlib import Path

from recon.errors import InputError
from recon.files import atomic


def check_place(document: Path, name: str) -> None:
    """Check that a document has a place for a table.

    Raises
    ------
    InputError
        If it has none, or is no file.
    """
    if not document.is_file():
        raise InputError(f"{document}: expected a Markdown file, found none")
    if not re.search(rf"<!-- {name} -->\n.*?<!-- /{name} -->", document.read_text(encoding="utf-8"), re.DOTALL):
        raise InputError(f"{document}: expected a place <!-- {name} --> ... <!-- /{name} -->, found none")


def refresh(document: Path, name: str, text: str) -> None:
    """Replace the table between `<!-- NAME -->` and `<!-- /NAME -->` in a document, under the date and commit of now.

    Raises
    ------
    InputError
        If the document has no place for it.
    """
    enter(document, name, f"{measured_line(document.parent)}\n\n{text}")


def enter(document: Path, name: str, text: str) -> None:
    """Replace what stands between `<!-- NAME -->` and `<!-- /NAME -->` in a document; raises InputError as `refresh` does."""
    check_place(document, name)
    before = document.read_text(encoding="utf-8")
    place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    with atomic.new_file(document) as temporary:
        temporary.write_text(place.sub(lambda match: f"{match[1]}\n{text}\n\n{match[2]}", before), encoding="utf-8")


def measured_line(folder: Path) -> str:
    """The state of a folder in a sentence: `Measured 2026-01-31 at 1a2b3c4.`; without a commit the date alone."""
    day, commit = state(folder)
    return f"Measured {day} at {commit}." if commit else f"Measured {day}."


def state(folder: Path) -> tuple[str, str]:
    """Date of today, UTC, and commit of the folder, with `+changes` if other files than pages and their rows differ from it.

    Outside a git repository, or without git, the commit is empty.
    """
    day = f"{datetime.now(UTC):%Y-%m-%d}"
    written = (":(top,exclude,glob)**/*.md", ":(top,exclude)docs/*.csv")
    try:
        commit = _git(folder, "rev-parse", "--short=7", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", ":/", *written)
    except (OSError, subprocess.CalledProcessError):
        return day, ""
    return day, f"{commit}{'+changes' if changed else ''}"


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()
