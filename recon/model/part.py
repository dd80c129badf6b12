"""The base of all settings and records, and numbers of usual ranges: what a module needs that reads some, and no more."""

from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from recon import registry

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


class Kinds(Part):
    """A thing of several kinds: each a module of a package, found by its name, with a subclass `Kind` of the thing's class.

    A `Kind` has the field `kind`, a literal of its module's name. What is read as the thing becomes the kind that it names.
    """

    PACKAGE: ClassVar[str]
    USUAL: ClassVar[str] = ""  # where none is named; empty where one must be

    if TYPE_CHECKING:
        kind: str  # a field of each kind, in the order of its own

    @classmethod
    def is_any(cls) -> bool:
        """Whether this is the thing, not one of its kinds."""
        return "PACKAGE" in vars(cls)

    @classmethod
    def named(cls, kind: str) -> type[Self]:
        """The class of a kind that is there."""
        return registry.kind(cls.PACKAGE, kind).Kind

    @classmethod
    def models(cls) -> list[type[Self]]:
        """The kinds."""
        return [module.Kind for module in registry.kinds(cls.PACKAGE).values()]

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Write any kind with its own fields, not with those that all kinds have."""
        schema = handler(source)
        if cls.is_any():
            schema["serialization"] = core_schema.simple_ser_schema("any")
        return schema

    @model_validator(mode="wrap")
    @classmethod
    def _of_its_kind(cls, value: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not cls.is_any() or not isinstance(value, Mapping):
            return handler(value)
        name = value.get("kind", cls.USUAL or None)
        if name in (there := registry.names(cls.PACKAGE)):
            return cls.named(name).model_validate(value)
        fault: Any = {"type": "union_tag_not_found", "input": value, "ctx": {"discriminator": "'kind'"}}
        if name is not None:
            expected = {"tag": str(name), "expected_tags": ", ".join(map(repr, there))}
            fault |= {"type": "union_tag_invalid", "ctx": fault["ctx"] | expected}
        raise ValidationError.from_exception_data(cls.__name__, [fault])


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
