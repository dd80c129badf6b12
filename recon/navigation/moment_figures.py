"""The figures of a moment as HTML for the page: whether the target is tracked, the plane's distance from each mass, what is late.

Each figure has a place of its own, with digits of one width, so that nothing on the page moves while they change. The B-scan is
part of the same text: a picture of its own would be loaded later, and stand beside the figures of another moment.
"""

from base64 import b64encode
from collections.abc import Iterable
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.navigation.mass_distances import MassDistance
from recon.navigation.publishing import Moment

NONE = "–"  # in the place of a figure that there is none of
NARROW = "36em"  # of the window, where viser has a sheet below in place of the panel beside

# The last rules are for a small window, of which the sheet would cover half.
STYLE = f"""<style>
.figures {{ padding: 0.4em 0.8em; font-size: 0.85em; line-height: 1.4; font-variant-numeric: tabular-nums; }}
.figures p {{ margin: 0 0 0.4em; min-height: 2.8em; overflow-wrap: anywhere; }}
.figures table {{ width: 100%; table-layout: fixed; border-collapse: collapse; margin-bottom: 0.4em; }}
.figures th {{ text-align: left; font-weight: 600; }}
.figures td {{ vertical-align: top; overflow-wrap: anywhere; }}
.figures .number {{ width: 40%; text-align: right; padding-right: 1.2em; white-space: nowrap; overflow-wrap: normal; }}
.figures img {{ display: block; width: 100%; }}
.figures .cut td {{ color: rgb(255, 210, 60); }}
.figures .alarm td {{ color: rgb(255, 125, 110); font-weight: 600; }}
.figures .state {{ height: 2.8em; }}
@media (max-width: {NARROW}) {{
  .mantine-Paper-root:has(.figures) {{ max-height: 40% !important; width: 17em !important; }}
  [style*="width: 20em"]:has(.figures) {{ width: 17em !important; }}
}}
</style>"""


def html_of(moment: Moment, masses: Iterable[str], picture: NDArray[np.uint8] | None = None, tools: str = "") -> str:
    """The figures of a moment; each mass has its row, whether there is a distance or none. Under them its B-scan : (h, w, 3).

    tools : tables of `recon.navigation.tool_figures`
    """
    tracked = "Tracking" if moment.world_from_target is not None else "Not tracking"
    parts = [f"<p><b>{tracked}:</b> {escape(moment.state)}</p>"]
    near = {each.name: each for each in moment.distances}
    if rows := [_row_of_mass(name, near.get(name)) for name in masses]:
        heads = '<th>mass</th><th class="number">plane, mm</th><th>cut</th>'
        parts.append(f"<table><tr>{heads}</tr>{''.join(rows)}</table>")
    parts.append(tools)
    parts.append(f"<table>{''.join(_row(*row) for row in _states(moment))}</table>")
    parts += [f"<p><b>Device:</b> {escape(trouble)}</p>" for trouble in moment.troubles]
    if picture is not None:
        parts.append(_image(picture))
    return f'<div class="figures">{"".join(parts)}</div>'


def _image(picture: NDArray[np.uint8]) -> str:
    """A picture : (h, w, 3) RGB within the text, which is painted with it."""
    quality = 85  # of JPEG
    jpeg = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    height, width = picture.shape[:2]
    source = f"data:image/jpeg;base64,{b64encode(jpeg).decode()}"
    return f'<img decoding="sync" width="{width}" height="{height}" style="height: auto" src="{source}">'


def _states(moment: Moment) -> Iterable[tuple[str, str]]:
    late = moment.latency
    yield "B-scan", "in place" if moment.scan is not None else "none in place"
    yield "Latency", NONE if late is None else f"{late.median_ms:.0f} ms, 99 % below {late.high_ms:.0f} ms"
    yield "Poses", NONE if late is None else f"{late.rate_hz:.0f} a second"
    if (seen := moment.seen) is not None:
        tissue = f"; tissue uneven by {seen.uneven_db:.1f} dB" if np.isfinite(seen.uneven_db) else ""
        yield "Seen", f"{100 * seen.share:.0f} % of {seen.planned_mm3 / 1000:.0f} cm³, {seen.source}{tissue}"


def _row(name: str, value: str) -> str:
    return f'<tr><th>{name}</th><td colspan="2">{value}</td></tr>'


def _row_of_mass(name: str, near: MassDistance | None) -> str:
    figure = NONE if near is None else f"{near.distance_mm:.1f}".replace("-", "−")  # as wide as a digit
    cut = "" if near is None or not near.cut else "in image" if near.in_image else "beside it"
    kind = ' class="cut"' if cut else ""
    return f'<tr{kind}><td>{escape(name)}</td><td class="number">{figure}</td><td>{cut or NONE}</td></tr>'
