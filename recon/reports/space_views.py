"""Views of surfaces, bodies and B-scans in space, to be turned in a browser: arrays in, plotly's JSON out."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from plotly import graph_objects

from recon.reports.figures import DIVERGING, Map, Mask, Scale

VERTICES = 60_000  # of a 3-D view; a laptop without a graphics card turns these smoothly
EYE = {"eye": {"x": -0.6, "y": -1.5, "z": 1.05}, "center": {"x": 0.02, "y": -0.05, "z": -0.22}}
EYE_INSIDE = {"eye": {"x": -0.8, "y": -1.45, "z": 0.85}, "center": {"x": 0.0, "y": 0.0, "z": -0.16}}
LEGEND = {"x": 0.99, "xanchor": "right", "y": 0.93, "bgcolor": "rgba(0,0,0,0)", "itemsizing": "constant"}  # beside no axis


@dataclass(frozen=True, eq=False)
class Shape:
    """A surface in a 3-D view."""

    name: str  # in the legend, which shows and hides it; the same name, the same entry
    vertices: NDArray  # (n, 3), mm
    triangles: NDArray  # (m, 3)
    colour: str
    opacity: float = 1.0
    shown: bool = True  # at first
    greys: NDArray[np.uint8] | None = None  # (n,) of the vertices, from black to the colour


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines in a 3-D view."""

    name: str
    points: NDArray  # (k, n, 3), mm: k lines of n points
    colour: str
    shown: bool = True  # at first


@dataclass(frozen=True, eq=False)
class Sheet:
    """A grey image in a 3-D view, where it lies in space."""

    name: str
    image: NDArray[np.uint8]  # (h, w)
    world_from_pixel: NDArray  # (4, 4), from (u, v, 0, 1) in px to mm


def surface_view(points: Map, error: Map, half_range: float = 0.1) -> str:
    """A surface to be turned, as the JSON of a plotly figure: vertices thinned out evenly, coloured by their error.

    Parameters
    ----------
    points : (h, w, 3), mm
        Organised by the camera's pixels, NaN where none. The camera looks along z, y is down.
    error : (h, w), mm
        Signed; points without it are left out.
    half_range : float, mm
        The colours span plus and minus this.
    """
    shown = np.isfinite(points).all(axis=-1) & np.isfinite(error)
    coarse = _thinned(shown, VERTICES)
    vertices, triangles = _triangulate(np.where(shown[coarse][..., None], points[coarse], np.float32(np.nan)))
    mesh = _mesh(
        vertices,
        triangles,
        intensity=error[coarse][shown[coarse]],
        colorscale=[[k / 12, colour] for k, colour in enumerate(Scale(DIVERGING, -1, 1).gradient())],
        cmin=-half_range,
        cmax=half_range,
        colorbar={"title": {"text": "error, mm", "side": "right"}, "thickness": 10, "len": 0.6, "outlinewidth": 0},
        hovertemplate="x %{x:.1f}<br>y %{y:.1f}<br>z %{z:.1f} mm<br>error %{intensity:.3f} mm<extra></extra>",
    )
    return graph_objects.Figure(mesh, _space(EYE), skip_invalid=False).to_json()


def surface_shape(points: Map, shown: Mask, name: str, colour: str, opacity: float) -> Shape:
    """A surface for `inside_view`, thinned out more: points : (h, w, 3) mm as of `surface_view`, where shown : (h, w)."""
    shown = shown & np.isfinite(points).all(axis=-1)
    fewer_vertices = 12_000  # of a surface that is there for what lies under it
    coarse = _thinned(shown, fewer_vertices)
    vertices, triangles = _triangulate(np.where(shown[coarse][..., None], points[coarse], np.float32(np.nan)))
    return Shape(name, vertices, triangles, colour, opacity)


def inside_view(shapes: Sequence[Shape], lines: Sequence[Lines], sheets: Sequence[Sheet], extent: NDArray | None = None) -> str:
    """Interactive 3-D view of a surface and the bodies under it, as the JSON of a plotly figure; its legend toggles the parts.

    extent : (n, 3) mm
        Points that the view is to hold, whatever else it shows.
    """
    traces: list[graph_objects.Mesh3d | graph_objects.Scatter3d | graph_objects.Surface] = []
    named: set[str] = set()

    def entry(name: str) -> dict[str, object]:
        first = name not in named
        named.add(name)
        return {"name": name, "legendgroup": name, "showlegend": first}

    sheet_step = 4  # px of a B-scan for one of its picture in space
    for sheet in sheets:
        rows, columns = (np.arange(0, size, sheet_step) for size in sheet.image.shape)
        u, v = np.meshgrid(columns, rows)
        pixels = np.stack([u, v, np.zeros_like(u)], axis=-1)
        place = np.float32(pixels @ sheet.world_from_pixel[:3, :3].T + sheet.world_from_pixel[:3, 3])
        blurred = cv2.blur(sheet.image, (sheet_step, sheet_step))[np.ix_(rows, columns)]
        grey = {"colorscale": [[0, "#000000"], [1, "#ffffff"]], "cmin": 0, "cmax": 255, "showscale": False, "hoverinfo": "skip"}
        flat = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
        axes = dict(zip("xyz", np.moveaxis(place, -1, 0), strict=True))
        traces.append(graph_objects.Surface(**axes, surfacecolor=blurred, lighting=flat, **grey, **entry(sheet.name)))
    for one in lines:
        joined = np.concatenate([np.vstack([line, np.full(3, np.nan)]) for line in np.asarray(one.points)]).astype(np.float32)
        visible = True if one.shown else "legendonly"
        style = {"mode": "lines", "line": {"color": one.colour, "width": 2}, "hoverinfo": "skip", "visible": visible}
        places = dict(zip("xyz", joined.T, strict=True))
        traces.append(graph_objects.Scatter3d(**places, **style, **entry(one.name)))
    for shape in sorted(shapes, key=lambda shape: -shape.opacity):  # translucent parts last
        hover = f"{shape.name}<br>x %{{x:.1f}}<br>y %{{y:.1f}}<br>z %{{z:.1f}} mm<extra></extra>"
        look: dict[str, object] = {"color": shape.colour, "opacity": shape.opacity, "hovertemplate": hover}
        if shape.greys is not None:
            scale = {"colorscale": [[0, "#000000"], [1, shape.colour]], "cmin": 0, "cmax": 255, "showscale": False}
            look = {"intensity": shape.greys, "opacity": shape.opacity, "hovertemplate": hover} | scale
        visible = True if shape.shown else "legendonly"
        traces.append(_mesh(shape.vertices, shape.triangles, **look, **entry(shape.name), visible=visible))
    if extent is not None:
        unseen = {"mode": "markers", "marker": {"size": 0.1, "opacity": 0}, "hoverinfo": "skip", "showlegend": False}
        traces.append(graph_objects.Scatter3d(**dict(zip("xyz", np.float32(extent).T, strict=True)), **unseen))
    layout = _space(EYE_INSIDE) | {"legend": LEGEND}
    return graph_objects.Figure(traces, layout, skip_invalid=False).to_json()


def _mesh(vertices: NDArray, triangles: NDArray, **style: object) -> graph_objects.Mesh3d:
    """A mesh of vertices : (n, 3) mm and triangles : (m, 3), lit from where the camera stands."""
    numbers = np.uint16 if len(vertices) <= 2**16 else np.int32  # half of the page's bytes are these
    return graph_objects.Mesh3d(
        **dict(zip("xyz", np.asarray(vertices, np.float32).T, strict=True)),
        **dict(zip("ijk", np.asarray(triangles, numbers).T, strict=True)),
        lighting={"ambient": 0.6, "diffuse": 0.65, "specular": 0.12, "roughness": 0.7, "fresnel": 0.05},
        lightposition={"x": -2000, "y": 3000, "z": -4000},
        **style,
    )


def _space(camera: dict[str, dict[str, float]]) -> dict[str, object]:
    """Layout of a 3-D view of the world: equal scales, the cameras of the rig above."""
    axis = {"showbackground": False, "showspikes": False, "zeroline": False, "nticks": 6}
    up = {"x": True, "y": "reversed", "z": "reversed"}  # a half turn that puts the camera above
    view = {
        "aspectmode": "data",
        "camera": camera,
        **{f"{name}axis": axis | {"title": {"text": f"{name}, mm"}, "autorange": up[name]} for name in "xyz"},
    }
    return {"scene": view, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}, "paper_bgcolor": "rgba(0,0,0,0)"}


def _thinned(shown: Mask, most: int) -> tuple[slice, slice]:
    """Subsampling stride of each axis that leaves about the wanted number of pixels."""
    stride = max(1, int(np.ceil(np.sqrt(np.count_nonzero(shown) / most))))
    return (slice(stride // 2, None, stride),) * 2


def _triangulate(points: Map) -> tuple[Map, NDArray[np.int32]]:
    """Vertices : (n, 3) and triangles : (m, 3) of a grid of points : (h, w, 3) with holes, less the long ones across a tear."""
    known = np.isfinite(points).all(axis=-1)
    number = np.cumsum(known).reshape(known.shape).astype(np.int32) - 1
    first, second = slice(None, -1), slice(1, None)
    corners = [(first, first), (first, second), (second, first), (second, second)]
    a, b, c, d = (points[corner] for corner in corners)
    reach = np.max([np.linalg.norm(p - q, axis=-1) for p, q in ((a, b), (a, c), (b, d), (c, d), (b, c))], axis=0)
    whole = np.isfinite(reach)
    longest = 6.0  # times the median: a longer triangle spans a tear
    whole[whole] = reach[whole] < longest * np.median(reach[whole]) if whole.any() else False
    ia, ib, ic, id_ = (number[corner][whole] for corner in corners)
    return points[known], np.concatenate([np.stack([ia, ic, ib], axis=1), np.stack([ib, ic, id_], axis=1)])
