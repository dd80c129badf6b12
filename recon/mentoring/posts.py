"""What a mentor may post: strokes and texts on a numbered picture of camera 1, undo, and clear."""

from typing import Annotated, Literal

from pydantic import Field, StringConstraints, TypeAdapter, ValidationError, field_validator

from recon.errors import InputError, one_line
from recon.model.part import Part

MOST_BYTES = 64_000  # of a post
MOST_PLACES = 2000  # of a stroke
MOST_LETTERS = 80  # of a text

Pixel = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False, strict=True)]
Place = tuple[Pixel, Pixel]  # u, v of camera 1's image
Picture = Annotated[int, Field(ge=0, le=2**53, strict=True)]  # number that the picture was sent with


class Stroke(Part):
    """A line drawn by hand."""

    kind: Literal["stroke"]
    picture: Picture
    places: Annotated[list[Place], Field(min_length=1, max_length=MOST_PLACES)]
    width_mm: Annotated[float, Field(ge=0.5, le=5, allow_inf_nan=False)] = 1.0
    dashed: Annotated[bool, Field(strict=True)] = False


class Text(Part):
    """A text that stands upright as camera 1 sees it."""

    kind: Literal["text"]
    picture: Picture
    at: Place
    text: Annotated[str, StringConstraints(min_length=1, max_length=MOST_LETTERS, strict=True)]
    height_mm: Annotated[float, Field(ge=3, le=30, allow_inf_nan=False)] = 6.0

    @field_validator("text")
    @classmethod
    def _of_letters(cls, text: str) -> str:
        if not text.isprintable() or not text.strip():
            raise ValueError("expected letters in one line, found others or blanks alone")
        return text


class Undo(Part):
    """Take back the last drawing of one's own."""

    kind: Literal["undo"]


class Clear(Part):
    """Take back all drawings, of all mentors."""

    kind: Literal["clear"]


Post = Annotated[Stroke | Text | Undo | Clear, Field(discriminator="kind")]
_POST: TypeAdapter[Post] = TypeAdapter(Post)


def read(content: bytes) -> Post:
    """A post from its JSON; InputError with the field, what was expected and what was found."""
    try:
        return _POST.validate_json(content)
    except ValidationError as error:
        raise InputError(one_line(error)) from None
