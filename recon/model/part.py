"""The base of all settings and records, and numbers of usual ranges: what a module needs that reads some, and no more."""

from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]

LARGEST = 1e12  # of any decimal number, whatever its unit: products of some stay finite
LARGEST_BY_UNIT = {"_mm": 1e6, "_px": 1e6, "_deg": 1e4, "_hz": 1e6, "_db": 1e3}  # by the ends of fields' names


class Part(BaseModel):
    """Base of settings and files' records: immutable, refuses unknown keys, and numbers that are endless or beyond reason."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _within_reach(cls, value: Any, info: ValidationInfo) -> Any:
        name = info.field_name or ""
        most = next((most for unit, most in LARGEST_BY_UNIT.items() if name.endswith(unit)), LARGEST)
        for number in _decimals(value):
            if not abs(number) <= most:
                raise ValueError(f"expected numbers of up to {most:g}, found {number:g}")
        return value


def _decimals(value: Any) -> Iterator[float]:
    """Decimal numbers of a field, those in lists and maps included."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _decimals(inner)
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _decimals(vars(value))
    elif isinstance(value, list | tuple | set | frozenset):
        for inner in value:
            yield from _decimals(inner)
