"""The page of a fused scene: all in one view that one can turn, with a slider along the sweep, and the masses in numbers."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.files import atomic
from recon.files.meshes import greys_of
from recon.files.metrics import Metrics
from recon.fusion import probe_shape
from recon.fusion.fused_scene import FusedScene, evenly, merged
from recon.fusion.palette import ON_PAGE
from recon.reports import page, space_views, sweep_player
from recon.reports.page import Opening, Section
from recon.reports.space_views import Lines, Shape
from recon.reports.sweep_player import Reel
from recon.segmentation.mass_files import FoundMass
from recon.segmentation.seen_map import Table

Array = NDArray[np.float64]

VIEW, SCAN = "scene", "B-scan"
STEP_MM = 1.5  # of the surfaces' vertices in the view
SLIDES = 60  # B-scans that the slider passes
FOOTER = "Measured in the frame of camera 1; nothing is registered."
UNKNOWN = "unknown"


def write(path: Path, scene: FusedScene, title: str) -> None:
    """Write the page."""
    text = page.render(opening(scene, title), [in_space(scene), *numbers(scene)], FOOTER)
    with atomic.new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def opening(scene: FusedScene, title: str) -> Opening:
    """The top of the page."""
    count = len(scene.masses or {})
    masses = f"{count} mass{'' if count == 1 else 'es'}" if count else "B-scans"
    parts = f"the skin by light and {masses}" if scene.skin is not None else masses
    said = f"{parts[:1].upper()}{parts[1:]} by ultrasound lie in one frame, that of camera 1, as they were measured."
    said += "" if count else f" {scene.search}"
    poses = ("B-scans with a pose", str(scene.scans.placed), f"of {len(scene.scans.world_from_pixel)}")
    unsaid = "the search failed" if scene.search_failed else "not looked for"
    tile = ("masses", UNKNOWN, unsaid) if scene.masses is None else ("masses", str(count), "")
    return Opening("sonotwin scene", title, said, [poses, tile])


def in_space(scene: FusedScene) -> Section:
    """The view, and its slider."""
    text = "Turn it with the mouse; a click in the legend shows or hides a part; the slider leads the probe along the sweep."
    reel = reel_of(scene)
    shapes, lines = list(_bodies(scene)), list(_wires(scene))
    if reel is None:
        return Section("All in one frame", [page.view(VIEW, space_views.inside_view(shapes, lines, []), text)])
    first = len(reel.images) // 2
    drawn = space_views.inside_view([*shapes, *reel.bodies_at(first)], lines, [reel.sheet_at(first)], reel.extent)
    return Section("All in one frame", [page.view(VIEW, drawn, text), sweep_player.player(VIEW, reel, first)])


def reel_of(scene: FusedScene) -> Reel | None:
    """B-scans along the sweep, with the probe; None without any."""
    numbers = evenly(list(scene.images), SLIDES)
    if not numbers or scene.scans.probe is None:
        return None
    body, rings = probe_shape.of(scene.target, scene.scans.probe, scene.scans.shape[1])
    parts = (("probe", body, ON_PAGE.body), ("circles", rings, ON_PAGE.ink))
    moving = [Shape(name, mesh.vertices, mesh.faces, colour) for name, mesh, colour in parts]
    labels = [f"B-scan {k} of {len(scene.scans.world_from_pixel)}" for k in numbers]
    images = [scene.images[k] for k in numbers]
    return Reel(SCAN, images, scene.scans.world_from_pixel[numbers], moving, scene.world_from_target[numbers], labels)


def _bodies(scene: FusedScene) -> Iterator[Shape]:
    """Everything that has a surface and rests."""
    for name, mesh, colour, opacity in (("skin", scene.skin, ON_PAGE.skin, 0.45), ("table", scene.rest, ON_PAGE.table, 1.0)):
        if mesh is not None:
            coarse = merged(mesh, STEP_MM)
            yield Shape(name, coarse.vertices, coarse.faces, colour, opacity, greys=greys_of(coarse))
    for name, mass in (scene.masses or {}).items():
        coarse = merged(mass.mesh, STEP_MM / 2)
        yield Shape(name, coarse.vertices, coarse.faces, ON_PAGE.mass)
    if scene.seen is not None and scene.seen.unseen is not None:
        mesh = scene.seen.unseen
        yield Shape("unseen", mesh.vertices, mesh.faces, ON_PAGE.unseen, 0.25, shown=False)  # it lies about all the rest


def _wires(scene: FusedScene) -> Iterator[Lines]:
    """The path of the array's face, and the devices' views."""
    if len(scene.path):
        yield Lines("path", scene.path, ON_PAGE.path)
    ray_mm = 60.0  # of a device, towards the corners of its view
    for name, camera in scene.devices.items():
        width, height = camera.size
        corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)
        ends = camera.centre + ray_mm * camera.rays(corners)
        round_ = np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)
        edges = np.stack([np.broadcast_to(camera.centre, ends.shape), ends], axis=1)
        yield Lines(name, np.concatenate([edges, round_]), ON_PAGE.device, shown=False)  # far away


def numbers(scene: FusedScene) -> Iterator[Section]:
    """The masses, what was left out, and what was seen, in tables, if there are any."""
    if scene.masses:
        head = ("", "centre x, y, z, mm", "volume, mm³", "below the skin, mm")
        rows = [(name, *row_of(mass)) for name, mass in scene.masses.items()]
        caption = "± one standard deviation, by poses, probe, latency, speeds of sound and speckle; of centres in space."
        yield Section("Masses", [page.table(head, rows, caption)])
    if scene.left_out:
        head = ("reason", "at x, y, z, mm", "seen of it, mm³", "")
        listed = [
            (one.reason, ", ".join(f"{v:.0f}" for v in one.centre_mm), f"{one.volume_mm3:.0f}", one.text)
            for one in scene.left_out
        ]
        yield Section("Left out", [page.table(head, listed, "Where a mass may be that isn't measured.")])
    if scene.seen is not None:
        yield seen_table(scene.seen.table)


def seen_table(table: Table) -> Section:
    """For each size and contrast the share of what was scanned in which such a mass would have been found."""
    head = ("mass", *(f"{contrast:g} dB" for contrast in table.contrasts_db))
    rows = [
        (f"{size:g} mm", *(f"{100 * share:.0f} %" for share in shares))
        for size, shares in zip(table.sizes_mm, table.shares, strict=True)
    ]
    told = "Share of what was scanned in which a mass of that size and contrast would have been found whole, had it been there, "
    told += f"{table.source}. The layer unseen, off at first, holds places where that is less than half of what B-scans "
    told += f"side by side give for {table.size_mm:g} mm and {table.contrast_db:g} dB, in what was scanned and beside it."
    return Section("Seen", [page.table(head, rows, told)])


def row_of(mass: FoundMass) -> tuple[str, str, str]:
    """Centre, volume and depth of a mass, each with its uncertainty, as text."""
    figures = mass.figures
    centre = ", ".join(f"{value:.2f}" for value in mass.mesh.center_mass) + _unsure(figures, "centre_sigma_mm", ".2f")
    volume = f"{mass.mesh.volume:.0f}" + _unsure(figures, "volume_sigma_mm3", ".0f")
    if not np.isfinite(figures.get("depth_mm", np.nan)):
        return centre, volume, UNKNOWN
    return centre, volume, f"{figures['depth_mm']:.2f}" + _unsure(figures, "depth_sigma_mm", ".2f")


def _unsure(figures: Metrics, name: str, how: str) -> str:
    value = figures.get(name, np.nan)
    return f" ± {value:{how}}" if np.isfinite(value) else ""
