"""Templates of image files' names, such as `<camera>/<pose>/<image>`, and the parts of a name that they read.

A template is the path of an image below its folder, with or without the suffix. `<camera>` stands for a camera's word, `<pose>`
for any text without a slash, `<image>` for the whole name of a file, or for a number where other text is beside it, and `*` for
anything within a name. An image whose template has no `<image>` is the only one of its pose, or the lit one.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from recon.capture.image_formats import SUFFIXES
from recon.errors import InputError

PLACES = ("camera", "pose", "image")
CAMERAS = {"cam1": "cam1", "camera1": "cam1", "left": "cam1", "cam2": "cam2", "camera2": "cam2", "right": "cam2"}  # word: device
FIRST = "cam1"  # which takes the images where names have no camera
OF_BOARDS = (  # usual names
    "<camera>/<pose>/<image>",
    "<pose>/<camera>/<image>",
    "<camera>_<pose>/<image>",
    "<pose>_<camera>/<image>",
    "<camera>/<pose>_<image>",
    "<pose>/<camera>_<image>",
    "<pose>/<image>_<camera>",
    "<camera>_<pose>_<image>",
    "<pose>_<camera>_<image>",
    "<pose>_<image>_<camera>",
    "<camera>/<pose>",
    "<pose>/<camera>",
    "<camera>_<pose>",
    "<camera><pose>",
    "<pose>_<camera>",
    "<pose>/<image>",
    "<pose>_<image>",
    "<pose>",
    "<camera>/<image>/<pose>",
    "<camera>/<image>_<pose>",
    "<camera>_<image>_<pose>",
    "*/<camera>_<pose>",
    "*/<camera><pose>",
    "<image>/<pose>",
    "<image>_<pose>",
)
OF_SURFACES = ("<camera>/<image>", "<camera>_<image>", "<camera><image>", "<image>_<camera>", "<image>")


class Words(NamedTuple):
    """Words in the names of images."""

    cameras: Mapping[str, str]  # in small letters -> device
    lit: tuple[str, ...]  # in the place of a lit image's number


class Name(NamedTuple):
    """An image by the parts of its path."""

    path: str  # below the folder, with slashes
    camera: str  # the device
    pose: str  # empty where the template has none, as are the next
    image: str


def usual(board: bool) -> list[str]:
    """Templates of usual names, of a board's poses or of a surface, with each separator."""
    templates = OF_BOARDS if board else OF_SURFACES
    separators = ("_", "-", " ", ".")  # that a template's _ stands for in the usual ones
    return list(dict.fromkeys(template.replace("_", separator) for template in templates for separator in separators))


def check(template: str) -> None:
    """Refuse a template with places of another name, or with one twice."""
    places = re.findall(r"<([^>]*)>", template)
    known = ", ".join(f"<{place}>" for place in PLACES)
    if not places or len(set(places)) < len(places) or not set(places) <= set(PLACES):
        raise InputError(f"files: expected {known}, each at most once, found {template}")


def read(paths: Iterable[str], templates: Sequence[str], words: Words) -> list[Name]:
    """Read the names of images by the first template that fits each; images that none fits are left out.

    Parameters
    ----------
    paths : below their folder, with slashes
    """
    expressions = [_expression(template, words) for template in templates]
    names = []
    for path in paths:
        found = next((match for expression in expressions if (match := expression.fullmatch(path))), None)
        if found is not None:
            parts = dict.fromkeys(PLACES, "") | found.groupdict()
            names.append(Name(path, words.cameras.get(parts["camera"].lower(), FIRST), parts["pose"], parts["image"]))
    return names


def _expression(template: str, words: Words) -> re.Pattern[str]:
    """Regular expression of a template."""
    stem, suffix = template, r"\.[^./]+"
    if template.lower().endswith(SUFFIXES):
        stem, dot, kind = template.rpartition(".")
        suffix = re.escape(dot + kind)
    numbered = "|".join([r"\d+", *map(re.escape, words.lit)])
    text = ""
    for piece in re.finditer(r"<(\w+)>|\*|[^<*]+", stem):
        whole = stem[: piece.start()][-1:] in ("", "/") and stem[piece.end() :][:1] in ("", "/")
        match piece[0]:
            case "<camera>":
                text += f"(?P<camera>{'|'.join(map(re.escape, words.cameras))})"
            case "<pose>":
                text += "(?P<pose>[^/]+?)"
            case "<image>":
                text += "(?P<image>[^/]+)" if whole else f"(?P<image>{numbered})"
            case "*":
                text += "[^/]*"
            case plain:
                text += re.escape(plain)
    return re.compile(text + suffix, re.IGNORECASE)
