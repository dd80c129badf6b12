"""The log of checks, a line of JSON each: a rig over days. A line is added to a copy, which takes the log's place as a whole."""

import hashlib
import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, Field, model_validator

from recon.errors import validated
from recon.files import atomic, json_text
from recon.files.regular import MOST_TEXT, read_text
from recon.geometry.camera_jacobian import MOTION
from recon.model.rig import Finite, NotNegative, Part
from recon.rig_check.bottom_equations import CLOCK
from recon.rig_check.optics_equations import TARGET
from recon.rig_check.rig_versions import Comparison
from recon.rig_check.verdicts import State, Verdict

ROUNDING = 1e-6  # of correlations
EXACT = 1e-9  # rad, mm or s: a standard deviation of what a check doesn't show at all
Covariance = tuple[tuple[Finite, ...], ...]
EPOCH, END = datetime(1970, 1, 1, tzinfo=UTC), datetime(2200, 1, 1, tzinfo=UTC)  # of times that a computer's clock shows


class Estimate(Part):
    """A part's motion against its calibration, with its covariance where nothing moved, for charts over the days.

    Turns in rad, then shifts in mm; of the target's lengths in mm; of the clock in s.
    """

    motion: tuple[Finite, ...] = Field(min_length=1)  # (k,)
    own: Covariance  # (k, k) by noise and by what is other each day
    common: Covariance  # (k, k) by errors of the calibration, the same in all checks
    against: str  # digest of what it was found by: calibration, and kinds of recordings

    @model_validator(mode="after")
    def _of_one_size(self) -> Self:
        k = len(self.motion)
        for name, rows in (("own", self.own), ("common", self.common)):
            if [len(row) for row in rows] != [k] * k:
                raise ValueError(f"{name}: expected {k} rows of {k} numbers, as motion has, found {[len(row) for row in rows]}")
            covariance = np.array(rows)
            sigma = np.sqrt(np.abs(np.diag(covariance)))
            unit = np.where(sigma > EXACT, sigma, 1.0)
            correlations = covariance / np.outer(unit, unit)
            even = np.abs(correlations - correlations.T).max() < ROUNDING
            if not even or np.linalg.eigvalsh(correlations).min() < -ROUNDING:
                raise ValueError(f"{name}: expected a covariance, symmetric and of no negative variance, found another matrix")
        return self


class Entry(Part):
    """One part in one check."""

    part: str
    state: State
    sigma: NotNegative | None = None  # None where nothing showed the part
    mm: NotNegative | None = None
    mm_sigma: NotNegative | None = None
    motion: str = ""
    rivals: tuple[str, ...] = ()
    estimate: Estimate | None = None  # None where nothing showed the part, and in logs of versions before 0.2.0

    @model_validator(mode="after")
    def _of_its_part(self) -> Self:
        found = 0 if self.estimate is None else len(self.estimate.motion)
        if self.part == TARGET and found and found % 2 == 0:
            raise ValueError(f"estimate.motion: expected an odd number of lengths, found {found}")
        expected = 1 if self.part == CLOCK else len(MOTION)
        if self.part != TARGET and found not in (0, expected):
            raise ValueError(f"estimate.motion: expected {expected} numbers of {self.part}, found {found}")
        return self


class Check(Part):
    """One check."""

    time: Annotated[AwareDatetime, Field(ge=EPOCH, lt=END)]
    name: str  # of the capture
    parts: tuple[Entry, ...] = Field(min_length=1)
    rig: Comparison | None = None  # its numbers against those of its file


def entry(verdict: Verdict) -> Entry:
    """A verdict as a record."""
    numbers = {name: getattr(verdict, name) for name in ("sigma", "mm", "mm_sigma")}
    known = {name: round(value, 5) if math.isfinite(value) else None for name, value in numbers.items()}
    found, estimate = verdict.finding, None
    if found is not None:
        matrices = {name: tuple(map(tuple, getattr(found, name).tolist())) for name in ("own", "common")}
        estimate = Estimate(motion=tuple(found.motion.tolist()), **matrices, against=verdict.against)
    told = {"part": verdict.part, "state": verdict.state, "motion": verdict.motion, "rivals": verdict.rivals}
    return Entry(**told, **known, estimate=estimate)


def digest(*arrays: NDArray | None) -> str:
    """A short digest of numbers that parts are checked against: another after each calibration."""
    whole = hashlib.sha256()
    for one in arrays:
        whole.update(b"none" if one is None else np.ascontiguousarray(one, float).tobytes())
    return whole.hexdigest()[:16]


def check(name: str, verdicts: Sequence[Verdict], rig: Comparison | None = None) -> Check:
    """The record of a check that was made now."""
    return Check(time=datetime.now(UTC).replace(microsecond=0), name=name, parts=tuple(map(entry, verdicts)), rig=rig)


def read(path: Path) -> list[Check]:
    """All checks of a log, in its order.

    Raises
    ------
    InputError
        If it is missing, or a line is damaged: the line is named.
    """
    lines = enumerate(read_text(path, MOST_TEXT, "a log of checks").splitlines(), start=1)
    return [validated(Check, json_text.parsed(path, line), f"{path}: line {k}") for k, line in lines if line.strip()]


def add(path: Path, made: Check) -> None:
    """Add a check; one process at a time does, and whatever stops it, the log stays whole.

    Raises
    ------
    InputError
        If the log that is there is damaged: it stays as it is.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.new_file(path) as temporary:
        checks = [*(read(path) if path.exists() else []), made]
        temporary.write_text("".join(json.dumps(one.model_dump(mode="json")) + "\n" for one in checks), encoding="utf-8")
