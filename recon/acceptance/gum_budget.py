"""Uncertainty budgets by the GUM: propagation (JCGM 100), and beside it distributions drawn through the model (JCGM 101)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]
Model = Callable[[Mapping[str, Array]], Array]

COVERAGE = 0.95
DRAWS = 50_000  # of the Monte Carlo: an end of the interval is then known to 1.2 % of the standard uncertainty
TOLERANCE = 0.05  # of a standard uncertainty, half a unit of its second digit where that counts most: to it Monte Carlo validates


@dataclass(frozen=True)
class Input:
    """A quantity that the test value depends on, and how well it is known."""

    name: str
    value: float
    standard: float  # standard uncertainty, in the unit of the value
    kind: Literal["A", "B"]  # A: by statistics of this measurement; B: by a certificate, a specification, experience
    unit: str = "mm"
    shape: Literal["normal", "rectangular"] = "normal"  # of its distribution; of kind A Student's t with its degrees of freedom
    freedom: float = np.inf  # degrees of freedom


@dataclass(frozen=True)
class Row:
    """A line of the budget."""

    input: Input
    sensitivity: float  # change of the test value for one unit of the input
    share: float  # of the variance

    @property
    def contribution_mm(self) -> float:
        """Standard uncertainty of the test value by this input alone."""
        return abs(self.sensitivity) * self.input.standard


@dataclass(frozen=True)
class Budget:
    """A test value with its uncertainty."""

    value_mm: float
    rows: tuple[Row, ...]
    standard_mm: float  # combined
    freedom: float  # effective, by Welch and Satterthwaite
    k: float  # coverage factor, for 95 %
    drawn_mm: tuple[float, float]  # ends of the 95 % interval by Monte Carlo, with 2.5 % on either side

    @property
    def propagated_mm(self) -> float:
        """Expanded uncertainty by propagation."""
        return self.k * self.standard_mm

    @property
    def validated(self) -> bool:
        """Whether Monte Carlo gives the ends that propagation gives, within the tolerance (JCGM 101, clause 8)."""
        ends = (self.value_mm - self.propagated_mm, self.value_mm + self.propagated_mm)
        return bool(np.all(np.abs(np.subtract(ends, self.drawn_mm)) <= TOLERANCE * self.standard_mm))

    @property
    def expanded_mm(self) -> float:
        """Expanded uncertainty U for 95 %: by propagation where Monte Carlo validates it, else the farther end by Monte Carlo."""
        low, high = self.drawn_mm
        return self.propagated_mm if self.validated else max(self.value_mm - low, high - self.value_mm)


def evaluate(model: Model, inputs: Sequence[Input], rng: np.random.Generator, draws: int = DRAWS) -> Budget:
    """Budget of a test value.

    Parameters
    ----------
    model : the test value in mm from inputs by their names, each : (n,)

    Sources: JCGM 100:2008, 5.1 (sensitivities by differences over one standard uncertainty to both sides, 5.1.3 note 2), G.4
    (effective degrees of freedom); JCGM 101:2008, 6.4 (distributions) and 7 (draws).
    """
    value, slopes = linearize(model, inputs)
    variances = np.array([(slope * one.standard) ** 2 for one, slope in zip(inputs, slopes, strict=True)])
    total = float(variances.sum())
    finite = sum(part**2 / one.freedom for part, one in zip(variances, inputs, strict=True))
    freedom = total**2 / finite if finite > 0 else np.inf
    drawn = model({one.name: _draw(one, rng, draws) for one in inputs})
    low, high = np.quantile(drawn, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    shares = variances / total if total > 0 else np.zeros(len(inputs))
    lines = tuple(Row(one, slope, float(share)) for one, slope, share in zip(inputs, slopes, shares, strict=True))
    k = float(stats.t.ppf((1 + COVERAGE) / 2, freedom))
    return Budget(value, lines, float(np.sqrt(total)), float(freedom), k, (float(low), float(high)))


def linearize(model: Model, inputs: Sequence[Input]) -> tuple[float, list[float]]:
    """A test value, and its sensitivity to each input."""
    values, slopes = {one.name: np.array([one.value]) for one in inputs}, list[float]()
    for one in inputs:
        step = one.standard or 1e-6 * max(abs(one.value), 1.0)
        ends = one.value + step * np.array([-1.0, 1.0])
        low, high = model({**{name: np.repeat(there, 2) for name, there in values.items()}, one.name: ends})
        slopes.append(float((high - low) / (2 * step)))
    return float(model(values)[0]), slopes


def _draw(one: Input, rng: np.random.Generator, draws: int) -> Array:
    if one.shape == "rectangular":
        return one.value + one.standard * np.sqrt(3) * rng.uniform(-1, 1, draws)
    unit = rng.standard_normal(draws) if np.isinf(one.freedom) else rng.standard_t(one.freedom, draws)
    return one.value + one.standard * unit
