"""Factors of a study: fields of its settings, by dotted names, and the values that each takes.

A factor is a list of values, a range, or a distribution. All combinations of lists and ranges are a full factorial design;
so many points of a space-filling one (scipy.stats.qmc) take any of them by their quantiles.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator
from scipy.stats import norm, qmc

from recon.errors import InputError, did_you_mean, one_line
from recon.model.rig import Part

Value = Any  # what YAML holds
Point = dict[str, Value]  # a value for each factor's field
Filling = Literal["sobol", "latin"]

JOINT = "+"  # between the names of fields that share a factor's values


class Range(Part):
    """Values from one to another, evenly, or by equal ratios."""

    first: float = Field(alias="from")
    last: float = Field(alias="to")
    count: Annotated[int, Field(ge=2, le=10_000)] = 5
    log: bool = False
    whole: bool = False  # numbers, rounded

    @model_validator(mode="after")
    def _upwards(self) -> "Range":
        if self.first >= self.last:
            raise ValueError(f"expected from below to, found {self.first:g} and {self.last:g}")
        if self.log and min(self.first, self.last) <= 0:
            raise ValueError(f"expected from and to above 0 with log, found {self.first:g} and {self.last:g}")
        return self

    def values(self) -> list[Value]:
        """All values."""
        even = (np.geomspace if self.log else np.linspace)(self.first, self.last, self.count).tolist()
        return list(dict.fromkeys(map(round, even))) if self.whole else even

    def quantile(self, share: float) -> Value:
        """The value below which a share of the range lies."""
        ratio, step = self.last / self.first if self.log else 1.0, self.last - self.first
        value = self.first * ratio**share if self.log else self.first + step * share
        return round(value) if self.whole else float(value)


class Normal(Part):
    """A normal distribution."""

    normal: tuple[float, Annotated[float, Field(gt=0)]]  # mean, standard deviation

    def quantile(self, share: float) -> Value:
        """The value that a share of the distribution lies below."""
        mean, deviation = self.normal
        return float(norm.ppf(share, mean, deviation))


class Choices(Part):
    """A list of values of any kind."""

    choices: Annotated[list[Value], Field(min_length=1, max_length=10_000)]

    def values(self) -> list[Value]:
        """All values."""
        return self.choices

    def quantile(self, share: float) -> Value:
        """The value whose place in the list a share of it is before."""
        return self.choices[min(int(share * len(self.choices)), len(self.choices) - 1)]


Factor = Choices | Range | Normal
KINDS = "a list, {from, to, count, log, whole} or {normal: [mean, deviation]}"


def read(over: Mapping[str, Any]) -> dict[str, Factor]:
    """Factors by their fields' names, as a person writes them; raises InputError with the name of one that is none."""
    factors = {}
    for name, given in over.items():
        kind = Choices if isinstance(given, list) else Normal if isinstance(given, Mapping) and "normal" in given else Range
        try:
            factors[str(name)] = TypeAdapter(kind).validate_python({"choices": given} if kind is Choices else given)
        except ValidationError as error:
            raise InputError(f"over: {name}: expected {KINDS}; {one_line(error)}") from None
    return factors


def factorial(factors: Mapping[str, Factor]) -> list[Point]:
    """All combinations of the factors' values, the last one's changing fastest; one without factors.

    Raises
    ------
    InputError
        For a distribution, which has no list of values.
    """
    for name, factor in factors.items():
        if isinstance(factor, Normal):
            raise InputError(f"over: {name}: a distribution needs points=N, the number of points of a space-filling design")
    lists = [factor.values() for factor in factors.values() if not isinstance(factor, Normal)]
    return [dict(zip(factors, values, strict=True)) for values in itertools.product(*lists)]


def filling(factors: Mapping[str, Factor], points: int, by: Filling) -> list[Point]:
    """Points that fill the factors' space evenly: the first ones of Sobol's sequence, scrambled, or a Latin hypercube."""
    if not factors:
        raise InputError("over: expected fields to vary with points=N, found none")
    sampler = {"sobol": qmc.Sobol, "latin": qmc.LatinHypercube}[by](len(factors), rng=np.random.default_rng(0))
    even = 1 << (points - 1).bit_length() if by == "sobol" else points  # Sobol's balance needs a power of two
    shares = np.clip(sampler.random(even)[:points], 1e-9, 1 - 1e-9)
    return [
        {name: factor.quantile(share) for (name, factor), share in zip(factors.items(), row, strict=True)}
        for row in shares.tolist()
    ]


def applied(settings: Mapping[str, Any], point: Point) -> dict[str, Any]:
    """Settings with a point's values in place; raises InputError with the name of a field that isn't there."""
    changed = deepcopy(dict(settings))
    for names, value in point.items():
        for name in names.split(JOINT):
            _put(changed, name, value)
    return changed


def value_at(settings: Mapping[str, Any], name: str) -> Any:
    """The value of a field; raises InputError with its name if it isn't there."""
    places: list[Any] = [settings]
    for part in name.split("."):
        places = [inner for place in places for inner in _entries(place, part, name)]
    return places[0]


def _put(settings: dict[str, Any], name: str, value: Value) -> None:
    """Put a value at a dotted name; a part of it is a key, a place in a list, or the kind of a list's entries."""
    places: Sequence[Any] = [settings]
    *way, last = name.split(".")
    for part in way:
        places = [inner for place in places for inner in _entries(place, part, name)]
    for place in places:
        for key in _keys(place, last, name):
            place[key] = deepcopy(value)


def _entries(place: Any, part: str, name: str) -> Iterator[Any]:
    return (place[key] for key in _keys(place, part, name))


def _keys(place: Any, part: str, name: str) -> list[Any]:
    """Keys of a place that a part of a name means."""
    if isinstance(place, Mapping):
        if part in place:
            return [part]
        known = [str(key) for key in place]
    elif isinstance(place, list):
        if part.isdigit() and int(part) < len(place):
            return [int(part)]
        kinds = [entry.get("kind") if isinstance(entry, Mapping) else None for entry in place]
        if part in kinds:
            return [k for k, kind in enumerate(kinds) if kind == part]
        known = [*map(str, range(len(place))), *sorted({kind for kind in kinds if kind})]
    else:
        raise InputError(f"over: {name}: {part}: expected a field, found that a value stands there already")
    raise InputError(f"over: {name}: unknown key {part}; expected one of {', '.join(known)}{did_you_mean(part, known)}")
