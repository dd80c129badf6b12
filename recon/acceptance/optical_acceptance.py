"""The tests: from points of artefacts, and of a tool's tip, in their places to test values with budgets, decisions and a verdict.

The measurand of a test value is the rig's error of indication in that place: what another measurement there would show in the
mean. So the noise of this one counts as uncertainty (type A), which ISO 14253-5 would leave out, where the error of this one
measurement is meant; its share stands in each budget. Errors of the rig's calibration are what is tested, and no uncertainty.

What a whole sequence shifts alike, such as a phase error of all fringes, shows where places are recorded again: the scatter of
repeats beyond their own noise, pooled over all such places, is then an input (type A) of every value of that quantity.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.acceptance import gum_budget, prescribed_places
from recon.acceptance.certificates import Artefacts, Certified, Material
from recon.acceptance.conformity import Decision, Limits, decide, together
from recon.acceptance.filament_probing import Seen
from recon.acceptance.form_probing import REPEATS, Probed, probe_plane, probe_sphere
from recon.acceptance.gum_budget import DRAWS, Budget, Input
from recon.acceptance.prescribed_places import Demand
from recon.acceptance.tool_probing import Seated, probe_divot
from recon.geometry.primitives import Plane, Sphere

Array = NDArray[np.float64]

REFERENCE_C = 20.0  # of certificates (ISO 1)
SEQUENCE = "sequence: scatter of repeats beyond their noise"


class Characteristic(NamedTuple):
    """A quantity that is tested."""

    title: str
    iso: str  # the nearest quantity of ISO 10360-13, or ""
    limit: str  # field of `Limits`


CHARACTERISTICS = {
    "PF": Characteristic("probing error of form, all points but 3 in 1000", "", "pf_mm"),
    "PF95": Characteristic("probing error of form, 95 % of the points", "P[Form.Sph.D95%]", "pf95_mm"),
    "PS": Characteristic("probing error of size", "P[Size.Sph.All]", "ps_mm"),
    "SD": Characteristic("sphere-spacing error", "D[CC]", "sd_mm"),
    "E": Characteristic("length measurement error, over both balls", "", "e_mm"),
    "F": Characteristic("flatness measurement error, all points but 3 in 1000", "", "f_mm"),
    "F95": Characteristic("flatness measurement error, 95 % of the points", "P[Form.Pla.D95%]", "f95_mm"),
    "TP": Characteristic("repeatability of a tool’s tip in a divot, RMS", "", "tp_mm"),
    "TD": Characteristic("error of divots’ distance by a tool’s tip", "", "td_mm"),
    "UD": Characteristic("calliper error between filaments in B-scans", "", "ud_mm"),
    "UL": Characteristic("lateral width of a filament’s echo, −6 dB", "", "ul_mm"),
    "UA": Characteristic("axial width of a filament’s echo, −6 dB", "", "ua_mm"),
}


class Test(NamedTuple):
    """A quantity in one place, not judged yet."""

    symbol: str  # of CHARACTERISTICS
    place: str
    points: int
    model: gum_budget.Model
    inputs: list[Input]


class Measured(NamedTuple):
    """Points of the artefacts, and a tip's places : (n, 3) mm, by the names of their places."""

    spheres: Mapping[str, Array]
    bars: Mapping[str, tuple[Array, Array]]
    planes: Mapping[str, Array]
    divots: Mapping[str, Array] = MappingProxyType({})  # see `divot_number`
    filaments: Mapping[str, Seen] = MappingProxyType({})


@dataclass(frozen=True)
class Judged:
    """A test in one place."""

    symbol: str  # of CHARACTERISTICS
    place: str
    points: int
    budget: Budget
    limit_mm: float | None
    decision: Decision | None  # None without a limit


@dataclass(frozen=True)
class Acceptance:
    """All tests of a rig."""

    values: tuple[Judged, ...]
    demands: tuple[Demand, ...]
    middles: Mapping[str, Array]  # of each kind of artefact (n, 3) mm, as measured

    @property
    def complete(self) -> bool:
        """Whether all demands on the arrangement are met."""
        return all(one.met for one in self.demands)

    @property
    def decision(self) -> Decision:
        """On the rig, by all values that have a limit: rejected where one is, accepted where all are."""
        return together(one.decision for one in self.values if one.decision is not None)

    @property
    def worst_values(self) -> dict[str, Judged]:
        """Of each quantity the value that decides: the largest together with its uncertainty."""
        found = dict[str, Judged]()
        for one in sorted(self.values, key=lambda one: abs(one.budget.value_mm) + one.budget.expanded_mm):
            found[one.symbol] = one
        return {symbol: found[symbol] for symbol in CHARACTERISTICS if symbol in found}

    def decision_of(self, symbol: str) -> Decision | None:
        """On a quantity in all its places; None without a limit."""
        own = [one.decision for one in self.values if one.symbol == symbol and one.decision is not None]
        return together(own) if own else None


def judge(
    measured: Measured, artefacts: Artefacts, limits: Limits, seed: int = 0, draws: int = DRAWS, repeats: int = REPEATS
) -> Acceptance:
    """Test values in all places, with decisions.

    Parameters
    ----------
    seed : of Monte Carlo and bootstrap

    Raises
    ------
    ValueError
        If points of a sphere lie in a plane.
    """
    rng, tests = np.random.default_rng(seed), list[Test]()
    middles: dict[str, dict[str, Array]] = {"sphere": {}, "bar": {}, "plane": {}}

    def add(symbol: str, place: str, points: int, model: gum_budget.Model, inputs: list[Input]) -> None:
        tests.append(Test(symbol, place, points, model, inputs))

    def forms(symbols: tuple[str, str], place: str, found: Probed[Sphere] | Probed[Plane], form_mm: float) -> None:
        for symbol, width in zip(symbols, (found.all, found.most), strict=True):
            add(symbol, place, len(found.residuals), _form, form_inputs(width.mm, width.sigma_mm, form_mm))

    for place, points in measured.spheres.items():
        assert artefacts.sphere is not None
        found = probe_sphere(points, rng, repeats)
        forms(("PF", "PF95"), place, found, artefacts.sphere.form_mm)
        add("PS", place, len(points), _size, size_inputs(found, artefacts))
        middles["sphere"][place] = found.shape.centre
    for place, (first, second) in measured.bars.items():
        balls = probe_sphere(first, rng, 2), probe_sphere(second, rng, 2)
        count = len(first) + len(second)
        add("SD", place, count, _spacing, spacing_inputs(balls, artefacts))
        add("E", place, count, _length, length_inputs(balls, artefacts))
        middles["bar"][place] = (balls[0].shape.centre + balls[1].shape.centre) / 2
    for place, points in measured.planes.items():
        assert artefacts.plane is not None
        found = probe_plane(points, rng, repeats)
        forms(("F", "F95"), place, found, artefacts.plane.form_mm)
        middles["plane"][place] = points.mean(axis=0)
    _judge_tool(measured.divots, artefacts, add)
    for place, seen in measured.filaments.items():
        _judge_scanner(place, seen, artefacts, add)
    values = list[Judged]()
    for symbol, quantity in CHARACTERISTICS.items():
        limit = getattr(limits, quantity.limit)
        for test in with_repeats([test for test in tests if test.symbol == symbol]):
            budget = gum_budget.evaluate(test.model, test.inputs, rng, draws)
            decision = None if limit is None else decide(budget.value_mm, budget.expanded_mm, limit)
            values.append(Judged(symbol, test.place, test.points, budget, limit, decision))
    placed = {
        kind: np.array([middle for place, middle in own.items() if place_of(place, own) == place])
        for kind, own in middles.items()
        if own
    }
    return Acceptance(tuple(values), tuple(prescribed_places.demands(artefacts, placed)), placed)


def place_of(name: str, names: Collection[str]) -> str:
    """The place that a recording repeats, `sphere/03` of `sphere/03-again` if that is among the names; else its own name."""
    first = name.partition("-")[0]
    return first if first in names else name


def with_repeats(tests: Sequence[Test]) -> list[Test]:
    """Tests of one quantity, where places were recorded again with the scatter of sequences as one more input.

    That is the variance of repeats about their places' means, pooled, less their own noise; with the former's degrees of freedom.
    """
    found = [gum_budget.linearize(test.model, test.inputs) for test in tests]
    names, groups = {test.place for test in tests}, dict[str, list[int]]()
    for number, test in enumerate(tests):
        if not test.place.startswith(("divots", "filaments")):  # whose words mean another thing, and whose images are repeats
            groups.setdefault(place_of(test.place, names), []).append(number)
    repeated = [own for own in groups.values() if len(own) > 1]
    if not repeated:
        return list(tests)
    freedom = sum(len(own) - 1 for own in repeated)
    scatter = sum(np.var([found[k][0] for k in own]) * len(own) for own in repeated) / freedom
    noise = [
        sum((slope * one.standard) ** 2 for one, slope in zip(tests[k].inputs, found[k][1], strict=True) if one.kind == "A")
        for own in repeated
        for k in own
    ]
    beyond = Input(SEQUENCE, 0.0, float(np.sqrt(max(scatter - np.mean(noise), 0.0))), "A", freedom=freedom)
    return [test._replace(model=partial(_shifted, test.model), inputs=[*test.inputs, beyond]) for test in tests]


def _shifted(model: gum_budget.Model, x: Mapping[str, Array]) -> Array:
    return model(x) + x[SEQUENCE]


def divot_number(place: str) -> tuple[int, bool]:
    """Number of the divot that a place's name begins with, and whether it has nothing else: `divots/03`, `divots/03-roll`.

    Raises
    ------
    ValueError
        If it has none.
    """
    number, _, words = place.rpartition("/")[2].partition("-")
    return int(number), not words


def _judge_tool(divots: Mapping[str, Array], artefacts: Artefacts, add: Callable[..., None]) -> None:
    """Repeatability in each divot, and distances of all pairs of those of which the tool stood as it does in use."""
    seated = {place: probe_divot(places) for place, places in divots.items()}
    for place, found in seated.items():
        add("TP", place, found.frames, _scatter, [Input("distance from the mean, RMS", found.rms_mm, found.rms_sigma_mm, "A")])
    for first, second in combinations([place for place in seated if divot_number(place)[1]], 2):
        words = f"{first}-{second.rpartition('/')[2]}"
        one, other = seated[first], seated[second]
        add("TD", words, one.frames + other.frames, _distance, distance_inputs((first, second), (one, other), artefacts))


def _judge_scanner(place: str, seen: Seen, artefacts: Artefacts, add: Callable[..., None]) -> None:
    """Callipers between all pairs of filaments, and the widths of each one's echo, by the mean of n B-scans."""
    assert artefacts.filaments is not None
    phantom, images = artefacts.filaments, len(seen.places)
    third = np.sqrt(3)
    speed = Input("speed of sound", phantom.speed_m_s, phantom.speed_limit_m_s / third, "B", "m/s", "rectangular")
    for first, second in combinations(range(len(seen.numbers)), 2):
        apart = (seen.places[:, second] - seen.places[:, first]) * [1.0, phantom.speed_m_s / phantom.screen.assumed_m_s]
        lengths = np.linalg.norm(apart, axis=1)  # of each B-scan, however it is tilted
        deep = float(np.mean((apart[:, 1] / lengths) ** 2))
        numbers = seen.numbers[first], seen.numbers[second]
        certified = _certified("certified distance", phantom.distance(*numbers))
        words = f"{place}, {numbers[0]}-{numbers[1]}"
        inputs = [_mean_of("distance, at the certified speed", lengths), speed, certified]
        add("UD", words, images, partial(_calliper, deep, phantom.speed_m_s), inputs)
    shown = phantom.screen.dynamic_range_db
    scale = Input("dynamic range", shown, phantom.screen.dynamic_range_limit_db / third, "B", "dB", "rectangular")
    for k, number in enumerate(seen.numbers):
        for axis, (symbol, model) in enumerate(
            (("UL", partial(_lateral, shown)), ("UA", partial(_axial, shown, phantom.screen.assumed_m_s)))
        ):
            widths = seen.widths[:, k, axis]
            if np.isfinite(widths).all():
                inputs = [_mean_of("width, as shown", widths), scale, *([speed] if symbol == "UA" else [])]
                add(symbol, f"{place}, {number}", images, model, inputs)


def _mean_of(name: str, values: Array) -> Input:
    """The mean of n repeats."""
    return Input(name, float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values))), "A", freedom=len(values) - 1)


def distance_inputs(names: tuple[str, str], seated: tuple[Seated, Seated], artefacts: Artefacts) -> list[Input]:
    """Inputs of an error of the distance of two divots."""
    assert artefacts.divots is not None
    apart = seated[1].mean - seated[0].mean
    length = float(np.linalg.norm(apart))
    inputs = [
        Input(f"tip in the {name} divot, towards the other", place, float(np.sqrt(apart @ one.covariance @ apart)) / length, "A",
              freedom=one.freedom)
        for name, place, one in zip(("first", "second"), (0.0, length), seated, strict=True)
    ]  # fmt: skip
    certified = artefacts.divots.distance(divot_number(names[0])[0], divot_number(names[1])[0])
    material = [one for one in _material(artefacts.divots, artefacts) if one.name != "paint"]
    return [*inputs, _certified("certified distance", certified), *material]


def form_inputs(width_mm: float, sigma_mm: float, form_mm: float) -> list[Input]:
    """Inputs of a form error: the artefact's own form counts with half its certified value (as in ISO/TS 23165)."""
    return [
        Input("width of the shell", width_mm, sigma_mm, "A"),
        Input("form of the artefact", 0.0, form_mm / 2, "B"),
    ]


def size_inputs(found: Probed[Sphere], artefacts: Artefacts) -> list[Input]:
    """Inputs of a sphere's size error."""
    assert artefacts.sphere is not None
    radius = float(np.sqrt(found.covariance[3, 3]))
    fitted = Input("fitted radius", found.shape.radius, radius, "A", freedom=found.freedom)
    return [fitted, _certified("certified diameter", artefacts.sphere.diameter), *_material(artefacts.sphere, artefacts)]


def spacing_inputs(balls: tuple[Probed[Sphere], Probed[Sphere]], artefacts: Artefacts) -> list[Input]:
    """Inputs of a spacing error."""
    assert artefacts.bar is not None
    along, apart = _along(balls)
    inputs = [
        Input(f"centre of the {name} ball, along the bar", place, float(np.sqrt(gradient @ one.covariance @ gradient)), "A",
              freedom=one.freedom)
        for name, place, one, gradient in zip(("first", "second"), (0.0, apart), balls, 2 * [np.append(along, 0.0)], strict=True)
    ]  # fmt: skip
    material = [one for one in _material(artefacts.bar, artefacts) if one.name != "paint"]
    return [*inputs, _certified("certified length", artefacts.bar.length), *material]


def length_inputs(balls: tuple[Probed[Sphere], Probed[Sphere]], artefacts: Artefacts) -> list[Input]:
    """Inputs of an error of the length over both balls."""
    assert artefacts.bar is not None
    along, apart = _along(balls)
    ends = ((-1, -balls[0].shape.radius), (1, apart + balls[1].shape.radius))
    inputs = [
        Input(f"outer end of the {name} ball", place, float(np.sqrt(gradient @ one.covariance @ gradient)), "A",
              freedom=one.freedom)
        for name, (side, place), one in zip(("first", "second"), ends, balls, strict=True)
        for gradient in [np.append(along, side)]
    ]  # fmt: skip
    certified = [_certified("certified length", artefacts.bar.length)]
    certified += [_certified(f"certified diameter {k + 1}", one) for k, one in enumerate(artefacts.bar.diameters)]
    return [*inputs, *certified, *_material(artefacts.bar, artefacts)]


def _along(balls: tuple[Probed[Sphere], Probed[Sphere]]) -> tuple[Array, float]:
    apart = balls[1].shape.centre - balls[0].shape.centre
    length = float(np.linalg.norm(apart))
    return apart / length, length


def _certified(name: str, one: Certified) -> Input:
    return Input(name, one.mm, one.standard_mm, "B")


def _material(body: Material, artefacts: Artefacts) -> list[Input]:
    """Temperature, expansion, paint and mounting."""
    third = np.sqrt(3)
    return [
        Input("temperature", artefacts.temperature_c, artefacts.temperature_limit_c / third, "B", "deg C", "rectangular"),
        Input("expansion", body.expansion_per_k, body.expansion_limit_per_k / third, "B", "1/K", "rectangular"),
        Input("paint", body.coat_mm, body.coat_limit_mm / third, "B", shape="rectangular"),
        Input("mounting", 0.0, body.mounting_mm, "B"),
    ]


def _grown(x: Mapping[str, Array]) -> Array:
    return 1 + x["expansion"] * (x["temperature"] - REFERENCE_C)


def _form(x: Mapping[str, Array]) -> Array:
    return x["width of the shell"] + x["form of the artefact"]


def _scatter(x: Mapping[str, Array]) -> Array:
    return x["distance from the mean, RMS"]


def _distance(x: Mapping[str, Array]) -> Array:
    apart = x["tip in the second divot, towards the other"] - x["tip in the first divot, towards the other"]
    return apart - x["certified distance"] * _grown(x) + x["mounting"]


def _calliper(deep: float, speed_m_s: float, x: Mapping[str, Array]) -> Array:
    stretched = np.sqrt(1 - deep + deep * (x["speed of sound"] / speed_m_s) ** 2)
    return x["distance, at the certified speed"] * stretched - x["certified distance"]


def _lateral(shown_db: float, x: Mapping[str, Array]) -> Array:
    return x["width, as shown"] * np.sqrt(shown_db / x["dynamic range"])  # of an echo that is a parabola in dB


def _axial(shown_db: float, assumed_m_s: float, x: Mapping[str, Array]) -> Array:
    return _lateral(shown_db, x) * x["speed of sound"] / assumed_m_s


def _size(x: Mapping[str, Array]) -> Array:
    return 2 * x["fitted radius"] - x["certified diameter"] * _grown(x) - 2 * x["paint"] + x["mounting"]


def _spacing(x: Mapping[str, Array]) -> Array:
    apart = x["centre of the second ball, along the bar"] - x["centre of the first ball, along the bar"]
    return apart - x["certified length"] * _grown(x) + x["mounting"]


def _length(x: Mapping[str, Array]) -> Array:
    over = x["outer end of the second ball"] - x["outer end of the first ball"]
    certified = x["certified length"] + (x["certified diameter 1"] + x["certified diameter 2"]) / 2
    return over - certified * _grown(x) - 2 * x["paint"] + x["mounting"]
