"""The exception for a user's mistake, reported in one line."""

import logging
import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Literal, TypeVar

from pydantic import BaseModel, ValidationError

log = logging.getLogger(__name__)

Implausible = Literal["refuse", "take"]  # a setting: what to do about lengths, poses and points that no rig and no hand makes
Model = TypeVar("Model", bound=BaseModel)
OWN_WORDS = {  # of kinds of pydantic's
    "int_parsing_size": "a whole number of fewer digits",
    "path_type": "a path",
    "tuple_type": "a list",
}
WAY = "to use them all the same, give implausible=take"
LONGEST = 60  # letters, of a found value in a message
MOST_LETTERS = 1000  # of a text that are looked at
MOST_BITS = 256  # of a number that is shown


class InputError(ValueError):
    """Bad input: a file, a field or a value that the software can't work with.

    The message is one line that names the file or the field, what was expected and what was found; the command line prints
    it as it is and exits with status 2. Raised before anything is written.
    """


def one_line(error: ValidationError) -> str:
    """The first fault that pydantic found, as `field: expected ..., found ...`."""
    first = error.errors()[0]
    place, kind, message, found = first["loc"], first["type"], first["msg"], first["input"]
    if kind.startswith("union_tag"):  # at fault is the field that tells which of several models is meant
        place += (first["ctx"]["discriminator"].strip("'"),)
    field = ".".join(
        short(str(piece)) for piece in place if not re.match(r"\w+\[", str(piece))
    )  # `literal[...]`: a choice of several types
    if kind == "missing" and isinstance(place[-1], int):
        text = "expected one more value, found none"
    elif kind in ("missing", "union_tag_not_found"):
        text = "expected a value, found none"
    elif kind in ("too_long", "too_short"):
        way, bound = ("at most", "max_length") if kind == "too_long" else ("at least", "min_length")
        text = f"expected a length of {way} {first['ctx'][bound]}, found {first['ctx']['actual_length']}"
    elif kind == "json_invalid":
        text = f"expected JSON, found damaged data: {first['ctx']['error']}"
    elif kind == "union_tag_invalid":
        text = f"expected one of {first['ctx']['expected_tags']}, found {first['ctx']['tag']!r}"
    elif kind in ("model_type", "model_attributes_type"):
        text = f"expected a map of fields, found {brief(found)}"
    elif kind == "extra_forbidden":
        text = f"expected no such field, found {brief(found)}"
    elif kind in OWN_WORDS:
        text = f"expected {OWN_WORDS[kind]}, found {brief(found)}"
    elif kind == "value_error":
        text = message.removeprefix("Value error, ")
        if field and not text.startswith("expected"):  # a model's own check names the field within it
            return f"{field}.{text}"
    else:
        expected = message.removeprefix("Input should be ").removeprefix("a valid ")
        text = f"expected {expected}, found {brief(found)}"
    return f"{field}: {text}" if field else text


def validated(model: type[Model], content: object, place: object) -> Model:
    """A record from the content of a file; raises InputError with the place, the field, what was expected and found."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{place}: {one_line(error)}") from None


def refuse_or_warn(place: str, seen: str, implausible: Implausible) -> None:
    """Refuse implausible data by what was seen of them, in a line that ends with the way past it; or warn of them."""
    if implausible == "take":
        log.warning("%s: taken all the same: %s", place, seen)
    else:
        raise InputError(f"{place}: {seen}{'' if seen.endswith('?') else ';'} {WAY}")


def did_you_mean(word: str, known: Sequence[str], before: str = "") -> str:
    """The nearest of known words, for the end of a message: one that is nearly alike, else one that has the word in it."""
    close = get_close_matches(word, known, n=1) or [name for name in known if len(word) > 2 and word in name][:1]
    return f"; did you mean {before}{close[0]}?" if close else ""


def printable(text: str) -> str:
    """A text of letters that any console takes: if it has others, all of them are escaped."""
    return text if text.isprintable() else text.encode("unicode_escape", "surrogatepass").decode("ascii")


def short(text: str, longest: int = LONGEST) -> str:
    """A text for a message: in one line, of letters that any console takes, and not longer than a number of them."""
    text = printable(" ".join(text[:MOST_LETTERS].split()))
    return text if len(text) <= longest else text[: longest - 3] + "..."


def reason(error: Exception) -> str:
    """The words of another library's exception for a message, or the exception's kind where it has none."""
    return short(str(error).strip() or type(error).__name__)


def brief(value: object) -> str:
    """The `repr` of a value of any size, or its beginning."""
    text = ""
    for piece in _pieces(value):
        text += piece
        if len(text) > LONGEST:
            break
    return short(text)


def _pieces(value: object) -> Iterator[str]:
    """Pieces of a value's `repr`, none of them long."""
    if isinstance(value, dict):
        for number, (key, inner) in enumerate(value.items()):
            yield ", " if number else "{"
            yield from _pieces(key)
            yield ": "
            yield from _pieces(inner)
        yield "}" if value else "{}"
    elif isinstance(value, list | tuple):
        begin, end = "[]" if isinstance(value, list) else "()"
        for number, inner in enumerate(value):
            yield ", " if number else begin
            yield from _pieces(inner)
        yield end if value else begin + end
    elif isinstance(value, int) and value.bit_length() > MOST_BITS:
        yield f"a number of {value.bit_length()} bits"
    else:
        yield repr(value[:LONGEST] + "..." if isinstance(value, str) and len(value) > LONGEST else value)
