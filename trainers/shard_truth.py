"""Truth of a data set's samples, as far as the networks learn from it: read strictly from a shard's JSON, then as arrays."""

from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StrictBool, model_validator

from recon.errors import validated
from recon.files import json_text
from recon.geometry.pose_hypotheses import POINTS

SEEN = 0.35  # of its disc, least that a circle is labelled with
HIDDEN = 0.05  # of its disc, most that a circle is nothing with; in between either answer is right
UNNAMED = -1  # identity of circles of which the detector learns the places alone
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


class CameraTruth(Known):
    """The camera of a view."""

    camera: Size


class TargetTruth(Known):
    """What one camera sees of a target; without the target before it all may be null."""

    centres: Annotated[tuple[Place, ...], Field(min_length=POINTS)] | None
    visible: tuple[Share, ...] | None = None
    inside: tuple[StrictBool, ...] | None = None
    blur_px: tuple[Length, ...] | None = None
    white_dn: Length | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
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


class PatchedTarget(TargetTruth):
    """The same with the patches' places."""

    patch_origins: Annotated[tuple[Place, ...], Field(min_length=POINTS)]
    ellipses: tuple[Ellipse, ...] | None

    @model_validator(mode="after")
    def _of_all_circles(self) -> Self:
        for name in ("centres", "ellipses"):
            found, expected = getattr(self, name), len(self.patch_origins)
            if found is not None and len(found) != expected:
                raise ValueError(f"{name}: expected {expected} values, as there are patches, found {len(found)}")
        return self

    @property
    def circles(self) -> int:
        """Number of the target's circles."""
        return len(self.patch_origins)


class ViewTruth(TargetTruth, CameraTruth):
    """What one camera sees of the probe's target."""


class PatchTruth(PatchedTarget, ViewTruth):
    """The same with the patches' places."""


class BodyTruth(Known):
    """A further body, by both views; its circles are as many in all samples."""

    kind: str  # of its target
    views: tuple[PatchedTarget, PatchedTarget]


class SampleTruth(Known):
    """A sample by its views."""

    k: Count | None = None
    seed: Count | None = None
    views: tuple[ViewTruth, ViewTruth]
    bodies: dict[str, BodyTruth] = Field(default_factory=dict)

    @property
    def others(self) -> dict[str, tuple[str, int]]:
        """Kind and number of circles of each further body's target."""
        return {name: (body.kind, body.views[0].circles) for name, body in self.bodies.items()}

    @model_validator(mode="after")
    def _as_many_in_both_views(self) -> Self:
        for name, body in self.bodies.items():
            one, other = (view.circles for view in body.views)
            if one != other:
                raise ValueError(f"bodies.{name}.views: expected as many circles in both, found {one} and {other}")
        return self


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
    """What is known of the circles of all targets in n views. Without a target centres are NaN and the rest is 0."""

    centres: Array  # (n, circles, 2) px of full resolution
    visible: Array  # (n, circles) fraction of each outer disc that is seen
    inside: NDArray[np.bool_]  # (n, circles)
    blur: Array  # (n, circles) px of full resolution
    white: Array  # (n, circles) digital number of the white about it


def facts(samples: Sequence[SampleTruth], circles: int) -> Facts:
    """Arrays of some samples' truth, of both views each: the probe's target of some circles, then those of further bodies."""
    targets = [_facts([view for sample in samples for view in sample.views], circles)]
    for name, (_, count) in samples[0].others.items():
        targets.append(_facts([view for sample in samples for view in sample.bodies[name].views], count))
    return Facts(*(np.concatenate(column, axis=1) for column in zip(*targets, strict=True)))


def _facts(views: Sequence[TargetTruth], circles: int) -> Facts:
    there = np.array([view.centres is not None for view in views])
    nothing = (0.0,) * circles
    centres = np.full((len(views), circles, 2), np.nan)
    centres[there] = np.reshape([view.centres for view in views if view.centres is not None], (-1, circles, 2))
    visible, inside, blur = (
        np.array([getattr(view, name) or nothing for view in views], float) for name in ("visible", "inside", "blur_px")
    )
    white = np.array([view.white_dn or 0.0 for view in views])
    return Facts(
        centres,
        np.where(there[:, None], visible, 0.0),
        np.where(there[:, None], inside, 0.0).astype(bool),
        np.where(there[:, None], blur, 0.0),
        np.repeat(np.where(there, white, 0.0)[:, None], circles, axis=1),
    )


def ellipses_in_patches(samples: Sequence[PatchedTruth], circles: int) -> Array:
    """Ellipses (n, circles, 5) of the discs of all targets, as of `facts`, as their patches show them; NaN without a target."""
    targets = [_ellipses([view for sample in samples for view in sample.views], circles)]
    for name, (_, count) in samples[0].others.items():
        targets.append(_ellipses([view for sample in samples for view in sample.bodies[name].views], count))
    return np.concatenate(targets, axis=1)


def _ellipses(views: Sequence[PatchedTarget], circles: int) -> Array:
    ellipses = np.full((len(views), circles, 5), np.nan)
    for ellipse, view in zip(ellipses, views, strict=True):
        if view.ellipses is not None:
            ellipse[:] = view.ellipses
            ellipse[:, :2] -= view.patch_origins
    return ellipses
