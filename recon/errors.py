"""The one exception that a user's mistake turns into, and the one line that says it."""

from pydantic import ValidationError


class InputError(ValueError):
    """Bad input: a file, a field or a value that the software can't work with.

    The message is one line that names the file or the field, what was expected and what was found; the command line prints
    it as it is and exits with status 2. Raised before anything is written.
    """


def one_line(error: ValidationError) -> str:
    """The first fault that pydantic found, as `field: expected ..., found ...`."""
    first = error.errors()[0]
    field = ".".join(str(piece) for piece in first["loc"])
    kind, message, found = first["type"], first["msg"], first["input"]
    if kind == "missing":
        text = "expected a value, found none"
    elif kind == "extra_forbidden":
        text = f"expected no such field, found {_brief(found)}"
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
