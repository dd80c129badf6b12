"""Figures of tools' tips in words: rows of the page's tables, a line for 3D Slicer, and what is an alarm.

An alarm has a word and a colour. Each row has a place of its own, whether the tool is seen or not; of one that isn't, no earlier
figure stays.
"""

from collections.abc import Iterable, Iterator
from html import escape
from typing import Annotated, NamedTuple

from pydantic import Field

from recon.model.part import NotNegative, Part, Positive
from recon.model.tip import Tip
from recon.navigation.publishing import BodyAt, Moment, StillScene
from recon.navigation.tool_distances import AtPlane, Distance, FromPath, TipFigures

NONE = "–"  # in the place of a figure that there is none of
AWAY = "not seen"
ASCII = {ord("±"): "+-", ord("−"): "-", ord("°"): " deg"}  # of a line for any program


class Alarms(Part):
    """When a tool's row is an alarm."""

    path_mm: Positive = 2.0
    """mm, of the tip off the planned path: the diameter of a biopsy needle of 14 gauge"""
    path_deg: Annotated[float, Field(gt=0, le=180)] = 3.0
    """deg, of the shaft to the planned path: 2 mm aside after 40 mm"""
    mass_mm: NotNegative = 2.0
    """mm, of the tip from a mass, likewise; 0: only within it"""


class Row(NamedTuple):
    """A figure of a tool."""

    name: str
    value: str
    note: str = ""
    alarm: bool = False  # of which the note is the word


def rows_of(tip: Tip | None, figures: TipFigures | None, scene: StillScene, alarms: Alarms) -> list[Row]:
    """Rows of a tool: as many, and in the same places, with its figures and without."""
    if tip is None:
        return [Row("tip", NONE, "not calibrated")]
    rows = [_of_mass(name, None if figures is None else figures.masses.get(name), alarms) for name in scene.masses]
    if scene.plan is not None:
        rows += _of_path(None if figures is None else figures.path, alarms)
    return [*rows, *_of_plane(None if figures is None else figures.plane)]


def html_of(moment: Moment, scene: StillScene, alarms: Alarms) -> str:
    """A table for each tool."""
    tables = []
    for name, tip in scene.tools.items():
        body = body_of(moment, name)
        seen = body.world_from_body is not None
        heads = f'<th>{escape(name)}</th><th class="number">tip, mm</th><th>note</th>'
        kind = "" if seen else ' class="alarm"'
        state = f'<tr{kind}><td colspan="3" class="state">{escape(_state(body))}</td></tr>'
        rows = "".join(map(_row, rows_of(tip, body.figures, scene, alarms)))
        tables.append(f"<table><tr>{heads}</tr>{state}{rows}</table>")
    return "".join(tables)


def line_of(moment: Moment, scene: StillScene, alarms: Alarms) -> str:
    """All tools in one line; lengths in mm."""
    parts = []
    for name, tip in scene.tools.items():
        body = body_of(moment, name)
        if body.world_from_body is None:
            parts.append(f"{name}: {_state(body)}")
            continue
        told = (
            f"{row.name} {row.value}{f' ({row.note.upper() if row.alarm else row.note})' if row.note else ''}"
            for row in rows_of(tip, body.figures, scene, alarms)
            if row.value != NONE
        )
        parts.append(f"{name}: {', '.join(told) or ('tip not calibrated' if tip is None else 'seen, no figures')}")
    return "; ".join(parts).translate(ASCII)


def body_of(moment: Moment, name: str) -> BodyAt:
    """A body at a moment, which isn't seen where the moment has no frames."""
    return next((body for body in moment.bodies if body.name == name), BodyAt(name, moment.state))


def _state(body: BodyAt) -> str:
    return body.state if body.world_from_body is not None else f"{AWAY}: {body.state.removeprefix('not found: ')}"


def _of_mass(name: str, distance: Distance | None, alarms: Alarms) -> Row:
    if distance is None:
        return Row(name, NONE)
    note = "in it" if distance.mm < 0 else "near" if distance.mm < alarms.mass_mm else ""
    return Row(name, _with_sigma(distance.mm, distance.sigma_mm), note, bool(note))


def _of_path(path: FromPath | None, alarms: Alarms) -> Iterator[Row]:
    if path is None:
        yield from (Row(name, NONE) for name in ("off path", "tilt", "to aim"))
        return
    off, beyond = path.off_mm > alarms.path_mm, path.left_mm < 0
    yield Row("off path", _with_sigma(path.off_mm, path.off_sigma_mm), "off path" * off, off)
    if path.angle_deg is None:
        yield Row("tilt", NONE, "no axis")
    else:
        tilted = path.angle_deg > alarms.path_deg
        yield Row("tilt", f"{path.angle_deg:.1f}°", "tilted" * tilted, tilted)
    yield Row("to aim", _number(path.left_mm), "beyond" * beyond, beyond)


def _of_plane(plane: AtPlane | None) -> Iterable[Row]:
    if plane is None:
        return Row("off image", NONE), Row("crossing", NONE)
    off = Row("off image", _with_sigma(plane.off_mm, plane.sigma_mm))
    if plane.crossing is None:
        return off, Row("crossing", NONE)
    where = "in image" if plane.crossing.in_image else "beside it"
    way = "ahead" if plane.crossing.ahead_mm >= 0 else "behind"
    return off, Row("crossing", f"{abs(plane.crossing.ahead_mm):.1f} {way}", where)


def _with_sigma(mm: float, sigma_mm: float) -> str:
    return f"{_number(mm)} ± {sigma_mm:.1f}"


def _number(mm: float) -> str:
    return f"{mm:.1f}".replace("-", "−")  # as wide as a digit


def _row(row: Row) -> str:
    kind = ' class="alarm"' if row.alarm else ""
    name, value, note = (escape(text) for text in (row.name, row.value, row.note or NONE))
    return f'<tr{kind}><td>{name}</td><td class="number">{value}</td><td>{note}</td></tr>'
