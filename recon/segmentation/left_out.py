"""What a search for masses leaves out, with its place, size and reason: bodies that aren't measured, and gaps of the scan."""

import json
import logging
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from recon.errors import validated
from recon.files import json_text
from recon.model.part import NotNegative, Part, Vector

log = logging.getLogger(__name__)

FILE = "left_out.json"
Reason = Literal[
    "cut by the sweep's end",
    "cut by the images' side",
    "cut by the images' lower end",
    "cut by a gap in the sweep",
    "cut by the ringing at the face",
    "its shadow hides its back",
    "in the shadow of a mass",
    "behind a cut body",
    "streak down the beam",
    "weak contrast",
    "small",
    "gap",
    "shadow of a mass",
    "at the scan's edge",
    "behind the tissue",
    "unsure",
    "looks like tissue",
]
UNLIKELY: tuple[Reason, ...] = ("shadow of a mass", "at the scan's edge", "behind the tissue", "looks like tissue")
"""reasons that are listed without a warning: what they are given to is hardly a mass"""


class LeftOut(Part):
    """A body that isn't measured, or a gap of the scan in which one may lie."""

    reason: Reason
    volume_mm3: NotNegative
    """of what is seen of it"""
    centre_mm: Vector
    """in the world"""
    extents_mm: tuple[NotNegative, NotNegative, NotNegative]
    """along the array, down the beam and across"""
    text: Annotated[str, Field(max_length=1000)]
    """a line for people"""

    def say(self) -> "LeftOut":
        """Log its line: a warning where a mass may be missing."""
        log.log(logging.INFO if self.reason in UNLIKELY else logging.WARNING, "%s", self.text)
        return self


class Listed(Part):
    """The content of the file."""

    left_out: tuple[LeftOut, ...] = ()


def write(path: Path, left_out: tuple[LeftOut, ...]) -> None:
    """Write the file, in a folder that appears whole."""
    path.write_text(json.dumps(Listed(left_out=left_out).model_dump(mode="json"), indent=1) + "\n", encoding="utf-8")


def read(path: Path) -> tuple[LeftOut, ...]:
    """Read the file; none of a folder that was written before there was one.

    Raises
    ------
    InputError
        If it is damaged.
    """
    return validated(Listed, json_text.read(path, "a list of what was left out"), path).left_out if path.is_file() else ()
