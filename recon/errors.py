"""The exception for a user's mistake, reported in one line."""

from pydantic import ValidationError

OWN_WORDS = {"int_parsing_size": "a whole number of fewer digits", "path_type": "a path"}  # of kinds of pydantic's


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
    field = ".".join(str(piece) for piece in place)
    if kind in ("missing", "union_tag_not_found"):
        text = "expected a value, found none"
    elif kind == "json_invalid":
        text = f"expected JSON, found damaged data: {first['ctx']['error']}"
    elif kind == "union_tag_invalid":
        text = f"expected one of {first['ctx']['expected_tags']}, found {first['ctx']['tag']!r}"
    elif kind in ("model_type", "model_attributes_type"):
        text = f"expected a map of fields, found {_brief(found)}"
    elif kind == "extra_forbidden":
        text = f"expected no such field, found {_brief(found)}"
    elif kind in OWN_WORDS:
        text = f"expected {OWN_WORDS[kind]}, found {_brief(found)}"
    elif kind == "value_error":
        text = message.removeprefix("Value error, ")
        if field and not text.startswith("expected"):  # a model's own check names the field within it
            return f"{field}.{text}"
    else:
        expected = message.removeprefix("Input should be ").removeprefix("a valid ")
        text = f"expected {expected}, found {_brief(found)}"
    return f"{field}: {text}" if field else text


def _brief(value: object) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
