"""A page that stands alone: one HTML file with its pictures, drawings and scripts inside, readable without a network.

A page is an opening and a list of sections; a section is a heading and blocks of HTML made by the functions below.
"""

import base64
import gzip
import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from string import Template

from plotly.offline import get_plotlyjs

from recon.reports import figures
from recon.reports.figures import Colours, Scale

FOLDER = Path(__file__).parent
UNITS = r"(?:(?:mm[²³]?|px|ms|m/s|s|DN|ppm|deg)(?!\w)|%|σ)"


@dataclass(frozen=True)
class Opening:
    """The top of a page: its subject and its results."""

    kind: str  # a few words above the title
    title: str
    result: str  # one sentence
    figures: Sequence[tuple[str, str, str]]  # label, value, unit


@dataclass(frozen=True)
class Section:
    """A part of a page."""

    title: str
    blocks: Sequence[str]  # HTML


def render(opening: Opening, sections: Iterable[Section], footer: str) -> str:
    """The page as HTML text; if it has 3-D views, with the program that draws them in it (2 MB)."""
    sections = list(sections)
    numbers = "".join(
        f"<div><dt>{_text(label)}</dt><dd>{value} <small>{unit}</small></dd></div>" for label, value, unit in opening.figures
    )
    top = (
        f'<div class="kind">{_text(opening.kind)}</div><h1>{_text(opening.title)}</h1>'
        f'<p class="result">{_text(opening.result)}</p><dl class="figures">{numbers}</dl>'
    )
    parts = [f"<section><h2>{_text(section.title)}</h2>\n" + "\n".join(section.blocks) + "</section>" for section in sections]
    has_views = any('class="view"' in block for section in sections for block in section.blocks)
    return _template("page.html").substitute(
        title=_text(opening.title),
        opening=top,
        sections="\n".join(parts),
        footer=_text(footer),
        scripts=_template("plotly.html").substitute(packed=_packed(get_plotlyjs())) if has_views else "",
    )


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{_text(text)}</p>"


def notices(lines: Iterable[str]) -> str:
    """Warnings for the reader, one item a line."""
    return '<ul class="notices">' + "".join(f"<li>{_text(line)}</li>" for line in lines) + "</ul>"


def picture(colours: Colours, caption: str, detail: str = "", scale: Scale | None = None, unit: str = "") -> str:
    """A picture with its caption, and a colour bar if it has a scale; a click enlarges it."""
    bar = colour_bar(scale, unit) if scale else ""
    alt = html.escape(caption, quote=True)
    return f'<figure><img src="{figures.webp(colours)}" alt="{alt}">{bar}{_caption(caption, detail)}</figure>'


def drawing(svg: str, caption: str, detail: str = "") -> str:
    """An SVG drawing with its caption."""
    return f"<figure>{svg}{_caption(caption, detail)}</figure>"


def view(name: str, plotly_json: str, caption: str) -> str:
    """A 3-D view to be turned."""
    figure = plotly_json.replace("</", "<\\/")
    return _template("view.html").substitute(name=name, figure=figure, caption=_text(caption))


def switch(name: str) -> str:
    """Buttons for the colour of a `space_views.surface_view` that stands on the page under this name: error, depth or plain."""
    return _template("switch.html").substitute(name=name)


def key(colours: Mapping[str, str]) -> str:
    """Legend of the lines' colours in pictures."""
    entries = "".join(f'<span><i style="background:{colour}"></i>{_text(name)}</span>' for name, colour in colours.items())
    return f'<p class="key">{entries}</p>'


def grid(blocks: Iterable[str], arrangement: str = "") -> str:
    """Blocks beside each other as far as the page is wide enough; `two` makes them larger."""
    return f'<div class="grid {arrangement}">' + "\n".join(blocks) + "</div>"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> str:
    """A table, to be scrolled where the page is narrower; a number in the last of three or more columns is emphasised."""
    top = "".join(f"<th scope='col'>{_text(cell)}</th>" for cell in head)
    body = ""
    for first, *others in rows:
        cells = [f"<td>{_together(cell)}</td>" for cell in others]
        if len(head) > 2:
            cells[-1] = cells[-1].replace("<td>", '<td class="number">') if others[-1][:1].isdigit() else cells[-1]
        body += f'<tr><th scope="row">{_text(first)}</th>{"".join(cells)}</tr>'
    below = f'<p class="below">{_text(caption)}</p>' if caption else ""
    inner = f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll" tabindex="0">{inner}</div>{below}'


def commands(lines: Iterable[str]) -> str:
    """Command lines to be copied."""
    return "<pre>" + _text("\n".join(lines)) + "</pre>"


def colour_bar(scale: Scale, unit: str) -> str:
    """A scale's colours with its ends and its middle."""
    low, middle, high = (_number(value) for value in (scale.low, (scale.low + scale.high) / 2, scale.high))
    gradient = f"linear-gradient(to right, {', '.join(scale.gradient())})"
    labels = "".join(f"<span>{label}</span>" for label in (low, f"{middle} {_text(unit)}", high))
    return f'<div class="bar"><i style="background:{gradient}"></i>{labels}</div>'


def count(number: float) -> str:
    """A whole number with thin spaces between thousands, at which no line breaks."""
    return f"{number:,.0f}".replace(",", "\u202f")


def _number(value: float) -> str:
    text = f"{value:.3g}" if abs(value) != math.pi else f"{value / math.pi:.0f}π".replace("1π", "π")
    return text.replace("-", "−")


@cache
def _packed(program: str) -> str:
    """A program's text, compressed to two fifths of its bytes, that the browser unpacks."""
    return base64.b64encode(gzip.compress(program.encode("utf-8"), mtime=0)).decode("ascii")


def _caption(caption: str, detail: str) -> str:
    return f"<figcaption><b>{_text(caption)}.</b> {_text(detail)}</figcaption>"


def _together(cell: str) -> str:
    """A cell's text whose numbers stay beside their units and uncertainties on narrow pages."""
    return re.sub(rf"(?<=\d) (?={UNITS}|± ?\d)|(?<=\d ±) (?=\d)", "\u00a0", _text(cell))


def _text(text: str) -> str:
    return html.escape(text, quote=False)


def _template(name: str) -> Template:
    return Template((FOLDER / name).read_text(encoding="utf-8"))
