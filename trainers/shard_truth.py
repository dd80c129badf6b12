"""Truth of a data set's samples, as far as the networks learn from it: read strictly from a shard's JSON, then as arrays."""

from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StrictBool, model_validator

from recon.errors import validated
from recon.files import json_text
from recon.geometry.pose_hypotheses import POINTS

SEEN = 0.35  # of its disc, least that a circle is labelled with
HIDDEN = 0.05  # of its disc, most that a circle is nothing with; in between either answer is right
FARTHEST = 1e6  # px, or digital numbers: more is no measurement, and overflows in 32 bits

Array = NDArray[np.float64]
Value = Annotated[float, Field(strict=True, ge=-FARTHEST, le=FARTHEST)]
Length = Annotated[float, Field(strict=True, ge=0, le=FARTHEST)]
Share = Annotated[float, Field(strict=True, ge=-1e-6, le=1 + 1e-6)]
Pixels = Annotated[int, Field(strict=True, ge=1, le=1 << 16)]
Count = Annotated[int, Field(strict=True, ge=0)]
Place = tuple[Value, Value]
Ellipse = tuple[Value, Value, Length, Length, Value]
Record = TypeVar("Record", bound="SampleTruth")


class Known(BaseModel):
    """Finite numbers; fields that the networks don't learn from may be there."""

    model_config = ConfigDict(allow_inf_nan=False, frozen=True)


class Size(Known):
    """The part of a camera that matters here."""

    size: tuple[Pixels, Pixels]  # width, height


class ViewTruth(Known):
    """What one camera sees; without a target before it all but the camera may be null."""

    camera: Size
    centres: Annotated[tuple[Place, ...], Field(min_length=POINTS)] | None
    visible: tuple[Share, ...] | None = None
    inside: tuple[StrictBool, ...] | None = None
    blur_px: tuple[Length, ...] | None = None
    white_dn: Length | None = None

    @model_validator(mode="after")
    def _complete(self) -> "ViewTruth":
        expected = None if self.centres is None else len(self.centres)
        for name in ("visible", "inside", "blur_px") if expected is not None else ():
            found = getattr(self, name)
            if found is None or len(found) != expected:
                given = "none" if found is None else len(found)
                raise ValueError(f"{name}: expected {expected} values, as there are centres, found {given}")
        return self

    @property
    def circles(self) -> int | None:
        """Number of the target's circles; None of a view that shows none."""
        return None if self.centres is None else len(self.centres)


class PatchTruth(ViewTruth):
    """The same with the patches' places."""

    patch_origins: Annotated[tuple[Place, ...], Field(min_length=POINTS)]
    ellipses: tuple[Ellipse, ...] | None

    @model_validator(mode="after")
    def _of_all_circles(self) -> "PatchTruth":
        for name in ("centres", "ellipses"):
            found, expected = getattr(self, name), len(self.patch_origins)
            if found is not None and len(found) != expected:
                raise ValueError(f"{name}: expected {expected} values, as there are patches, found {len(found)}")
        return self

    @property
    def circles(self) -> int:
        """Number of the target's circles."""
        return len(self.patch_origins)


class SampleTruth(Known):
    """A sample by its views."""

    k: Count | None = None
    seed: Count | None = None
    views: tuple[ViewTruth, ViewTruth]


class PatchedTruth(SampleTruth):
    """The same with the patches' places."""

    views: tuple[PatchTruth, PatchTruth]


def parse(place: str, content: bytes, model: type[Record]) -> Record:
    """Read a sample's JSON; InputError in one line where it is damaged, or a field isn't what it should be."""
    return validated(model, json_text.of_bytes(Path(place), content), place)


def identity(truth: SampleTruth, content: bytes) -> int:
    """A number that two samples share if they are the same one, which seed, k and all else agree on; 0 where it isn't known."""
    known = truth.k is not None and truth.seed is not None
    return int.from_bytes(blake2b(content, digest_size=8).digest(), "big") if known else 0


class Facts(NamedTuple):
    """What is known of n views. Without a target centres are NaN and the rest is 0."""

    size: Array  # (n, 2) px, width and height in full resolution
    centres: Array  # (n, circles, 2) px of full resolution
    visible: Array  # (n, circles) fraction of each outer disc that is seen
    inside: NDArray[np.bool_]  # (n, circles)
    blur: Array  # (n, circles) px of full resolution
    white: Array  # (n,) digital number of the target's white


def facts(views: Sequence[ViewTruth], circles: int) -> Facts:
    """Arrays of some views' truth, of a target of some circles."""
    there = np.array([view.centres is not None for view in views])
    nothing = (0.0,) * circles
    centres = np.full((len(views), circles, 2), np.nan)
    centres[there] = np.reshape([view.centres for view in views if view.centres is not None], (-1, circles, 2))
    visible, inside, blur = (
        np.array([getattr(view, name) or nothing for view in views], float) for name in ("visible", "inside", "blur_px")
    )
    return Facts(
        np.array([view.camera.size for view in views], float),
        centres,
        np.where(there[:, None], visible, 0.0),
        np.where(there[:, None], inside, 0.0).astype(bool),
        np.where(there[:, None], blur, 0.0),
        np.where(there, [view.white_dn or 0.0 for view in views], 0.0),
    )


def ellipses_in_patches(views: Sequence[PatchTruth], circles: int) -> Array:
    """Ellipses (circles n, 5) of views' discs as their patches show them; NaN without a target."""
    ellipses = np.full((len(views), circles, 5), np.nan)
    for ellipse, view in zip(ellipses, views, strict=True):
        if view.ellipses is not None:
            ellipse[:] = view.ellipses
            ellipse[:, :2] -= view.patch_origins
    return ellipses.reshape(-1, 5)
