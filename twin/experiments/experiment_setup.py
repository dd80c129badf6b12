"""What all experiments with bars have at hand."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from recon.errors import InputError
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from recon.session.store import files_of
from twin.conditions import IDEAL, Conditions
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound.transducer import Transducer

Figures = dict[str, Any]  # numbers by name


@dataclass(frozen=True)
class Setup:
    """Rig, inputs of `conf/`, and recordings."""

    rig: Rig
    sequences: Mapping[str, Patterns] = field(default_factory=dict)  # by their names in conf/patterns
    real: Path | None = None  # folder of real recordings
    scanners: Mapping[str, Transducer] = field(default_factory=dict)  # by their names in conf/ultrasound
    frames: DataRanges | None = None  # of tracking frames, as in conf/dataset.yaml
    out: Path | None = None  # folder for figures; without it none is drawn
    lifelike: Conditions | None = None  # as in conf/conditions/lifelike.yaml

    def conditions(self, life: Literal["ideal", "lifelike"]) -> Conditions:
        """Conditions by name; raises InputError if those of life were not given, which no others may stand for."""
        if life == "ideal":
            return IDEAL
        if self.lifelike is None:
            raise InputError("conditions: expected lifelike ones, as in conf/conditions/lifelike.yaml, found none in this setup")
        return self.lifelike

    @cached_property
    def digest(self) -> str:
        """Of all of it but `out`; recordings by the names, sizes and times of their files."""
        content = TypeAdapter(Setup).dump_python(self, mode="json", exclude={"out", "real"})
        return digest_of([content, files_of([self.real]) if self.real else None])


def digest_of(content: object) -> str:
    """Digest of what JSON can hold."""
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:20]
