"""The rig's description with what was measured in it, as a file for `rig=FILE`.

Each line of it says how well its number is known and from what, or why it isn't measured.
"""

import math
from collections.abc import Iterator, Mapping
from datetime import date
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from recon.errors import InputError, one_line
from recon.files import atomic
from recon.identification.estimates import Estimate, Findings
from recon.model.rig import Identified, Measured, Rig

DIGITS = 2  # of a standard deviation, to which a value is written


def apply(rig: Rig, findings: Findings) -> Rig:
    """The rig with the measured numbers in place of the assumed ones; those of other groups than the rig don't count.

    A camera's nominal focal length follows its calibrated one and the pixel's size, as these must agree.

    Raises
    ------
    InputError
        If a value can't be, or a name is none of the rig's.
    """
    content = rig.model_dump(mode="json")
    numbers = {name: value for name, value in findings.estimates.items() if name.partition(".")[0] in Rig.model_fields}
    for name, estimate in numbers.items():
        put(content, name, estimate.value, "rig")
    for camera in ("cam1", "cam2"):
        if f"{camera}.optics.focal_px.0" in numbers:
            device = content[camera]
            device["lens"]["focal_length_mm"] = device["optics"]["focal_px"][0] * device["sensor"]["pixel_um"] * 1e-3
    measured = {name: {"sigma": estimate.sigma, "source": estimate.source} for name, estimate in numbers.items()}
    content["measured"] = content["measured"] | measured
    try:
        return Rig.model_validate(content)
    except ValidationError as error:
        raise InputError(f"rig: as measured, it can't be: {one_line(error)}") from error


def next_version(rig: Rig, capture: str, day: date) -> Rig:
    """The rig as identified from a capture of a name and a day: one version on from that with which identification began."""
    return rig.model_copy(update={"version": rig.version + 1, "identified": Identified(day=day, capture=capture)})


def put(content: Any, name: str, value: float, described: str) -> None:
    """Put a number into nested maps and lists by its dotted name; InputError, of what is described, if there is none."""
    *parents, last = name.split(".")
    try:
        for key in parents:
            content = content[int(key)] if isinstance(content, list) else content[key]
        key = int(last) if isinstance(content, list) else last
        content[key] = round(value) if isinstance(content[key] + 0, int) else value
    except (KeyError, IndexError, ValueError, TypeError):
        raise InputError(f"{described}: expected the name of one of its numbers, found {name}") from None


def write(path: Path, rig: Rig, unknown: Mapping[str, str], heading: str) -> None:
    """Write a rig whole or not at all, a line a value, with what is known of it.

    unknown : numbers that the captures don't show, and why
    heading : a line or more at the top, about what it was measured from
    """
    write_fields(path, rig.model_dump(mode="json"), rig.measured, unknown, heading)


def write_fields(
    path: Path, content: Mapping[str, Any], measured: Mapping[str, Measured], unknown: Mapping[str, str], heading: str
) -> None:
    """Write any description likewise, by the dotted names of its fields."""
    lines = [*(f"# {line}" for line in heading.splitlines()), *_lines(content, "", measured, unknown)]
    with atomic.new_file(path) as new:
        new.write_text("\n".join(lines) + "\n", encoding="utf-8")


def in_words(one: Estimate) -> str:
    """A number and its standard deviation, as far as it is known, such as 1736.471 ± 0.073."""
    if not 1e-6 < one.sigma < math.inf:
        return f"{one.value:.5g} ± {one.sigma:.2g}"
    decimals = max(DIGITS - 1 - math.floor(math.log10(one.sigma)), 0)
    return f"{one.value:.{decimals}f} ± {one.sigma:.{decimals}f}"


def _lines(content: Mapping[str, Any], above: str, measured: Mapping[str, Measured], unknown: Mapping[str, str]) -> Iterator[str]:
    indent = "  " * above.count(".")
    for key, value in content.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping) and value:
            yield f"{indent}{key}:"
            yield from _lines(value, f"{name}.", measured, unknown) if name != "measured" else _measures(value)
        elif isinstance(value, list) and value and isinstance(value[0], list):
            yield f"{indent}{key}:"
            yield from (f"{indent}- {_text(_rounded(name, row, measured))}" for row in value)
        else:
            remark = _remark(name, value, measured, unknown)
            yield f"{indent}{key}: {_text(_rounded(name, value, measured))}" + (f"  # {remark}" if remark else "")


def _text(value: Any) -> str:
    """A value in one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=10_000).removesuffix("\n...\n").strip()


def _measures(content: Mapping[str, Any]) -> Iterator[str]:
    for name, one in content.items():
        yield f"  {name}: {yaml.safe_dump(one, default_flow_style=True, width=10_000, sort_keys=False).strip()}"


def _rounded(name: str, value: Any, measured: Mapping[str, Measured]) -> Any:
    """A value as far as it is known, and a digit more; of optics, whose numbers are known together far better, all digits."""
    if isinstance(value, list):
        return [_rounded(f"{name}.{k}", one, measured) for k, one in enumerate(value)]
    if not isinstance(value, float):
        return value
    if name in measured and measured[name].sigma > 0 and ".optics." not in name:
        return round(value, DIGITS - 1 - math.floor(math.log10(measured[name].sigma)))
    return float(f"{value:.12g}")


def _remark(name: str, value: Any, measured: Mapping[str, Measured], unknown: Mapping[str, str]) -> str:
    """What a line says of its value."""
    names = [f"{name}.{k}" for k in range(len(value))] if isinstance(value, list) else [name]
    if known := [measured[one] for one in names if one in measured]:
        return f"± {', '.join(f'{one.sigma:.2g}' for one in known)}: {known[0].source}"
    reasons = [unknown[one] for one in names if one in unknown]
    return f"not measured: {reasons[0]}" if reasons else ""
