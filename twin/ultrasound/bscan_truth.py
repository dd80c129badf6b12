"""Ground truth of a B-scan: each pixel's label, the exact section of each object, and the image without artefacts."""

from collections import defaultdict

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.geometry import rigid
from recon.threads import in_threads
from twin.displacement import moved_to
from twin.ultrasound import bmode_image
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.scan_lines import converted, lines_of, widening
from twin.ultrasound.sound_paths import Paths
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]


def labels(paths: Paths, transducer: Transducer) -> NDArray[np.uint8]:
    """Label of what each pixel shows : (h, w), 0 the surroundings, k + 1 solid k; delays and refraction included."""
    rows, lines = transducer.rows_mm, lines_of(transducer)
    shown = np.empty((len(rows), len(paths.labels)), np.uint8)
    in_threads(_fill_labels, len(paths.labels), shown, paths, rows, np.float32(lines.pitch_mm) * widening(rows, lines.bend))
    return converted(shown, transducer, order=0)


def masks(shown: NDArray[np.uint8], solids: int) -> NDArray[np.bool_]:
    """Where each solid is seen : (n, h, w), from the labels."""
    return shown == np.arange(1, solids + 1)[:, None, None]


def echo_free(shown: NDArray[np.uint8], body: Body, transducer: Transducer) -> NDArray[np.uint8]:
    """Mean grey of each pixel's tissue : (h, w), without speckle, surfaces, loss, blur or noise; 0 beside a fan."""
    reference = [0.0 if tissue.echogenicity is None else 10 ** (tissue.echogenicity / 20) for tissue in body.tissues]
    share = bmode_image.compressed(np.array(reference, np.float32)[shown], transducer)
    on_lines = np.ones((len(transducer.rows_mm), lines_of(transducer).count), np.float32)
    return bmode_image.grey(share * converted(on_lines, transducer, order=0), transducer)


def sections(body: Body, world_from_image: Array) -> dict[str, list[Array]]:
    """Exact sections with the image plane, by name: closed outlines : (m, 2) mm in the image's frame, of true depth.

    A wire that crosses the plane gives the one point (1, 2) of its axis.
    """
    image_from_world = rigid.invert(world_from_image)
    found = {}
    for solid in body.solids:
        if not solid.is_layer:
            places = moved_to(body.field, np.asarray(solid.mesh.vertices))
            found[solid.name] = _outlines(trimesh.Trimesh(places, solid.mesh.faces, process=False), image_from_world)
    for wire in body.wires:
        ends = rigid.apply(image_from_world, wire.ends)
        if ends[0, 2] * ends[1, 2] < 0:
            share = ends[0, 2] / (ends[0, 2] - ends[1, 2])
            found[wire.name] = [(ends[:1] + share * (ends[1:] - ends[:1]))[:, :2]]
    return {name: outlines for name, outlines in found.items() if outlines}


def _outlines(mesh: trimesh.Trimesh, image_from_world: Array) -> list[Array]:
    world_from_image = rigid.invert(image_from_world)
    segments = trimesh.intersections.mesh_plane(mesh, world_from_image[:3, 2], world_from_image[:3, 3])
    if len(segments) == 0:
        return []
    points = rigid.apply(image_from_world, segments)[..., :2]
    same_mm = 1e-5  # between ends of neighbouring segments of a section
    keys, index = np.unique(np.rint(points.reshape(-1, 2) / same_mm).astype(np.int64), axis=0, return_inverse=True)
    places = keys * same_mm
    return [places[loop] for loop in _loops(index.reshape(-1, 2))]


def _loops(edges: NDArray[np.int64]) -> list[list[int]]:
    """Closed walks over edges : (n, 2) of node numbers, each edge once."""
    neighbours: dict[int, list[int]] = defaultdict(list)
    for a, b in edges.tolist():
        if a != b:
            neighbours[a].append(b)
            neighbours[b].append(a)
    loops = []
    for start in list(neighbours):
        walk = [start]
        while neighbours[walk[-1]]:
            onwards = neighbours[walk[-1]].pop()
            neighbours[onwards].remove(walk[-1])
            walk.append(onwards)
        if len(walk) > 3:
            loops.append(walk)
    return loops


@kernel
def _fill_labels(first, end, shown, paths, rows_mm, line_mm):
    lines, depths = paths.labels.shape
    for line in range(first, end):
        level = 0  # the one that is shown nearest to a row's depth
        for row in range(len(rows_mm)):
            while level < depths - 1 and (paths.shown_mm[line, level] + paths.shown_mm[line, level + 1]) / 2 < rows_mm[row]:
                level += 1
            place = line  # that is shown on this line: shifts are those of places
            for _ in range(3):
                aside = int(np.rint(np.float32(line) + paths.shift_mm[place, level] / line_mm[row]))
                place = min(max(aside, 0), lines - 1)
            shown[row, line] = paths.labels[place, level]
