"""Accuracy of sound's ways through tissue: against k-Wave, which solves the wave equation.

k-Wave's figures and their media are kept in `kwave_peer.json` beside this module, so that they count as its code, with the
command that makes them; it is no dependency. Its simulations are in the image's plane, the twin's here in three dimensions:
nothing changes across the plane.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from scenes import solid_meshes as shapes
from scenes.acoustics import TISSUES
from scenes.scene_types import Material, Thing
from scenes.tissue import Tissue
from twin.experiments.bmode_accuracy import QUIET, looking_down, width
from twin.experiments.experiment_setup import Figures, Setup
from twin.ultrasound import bmode_image
from twin.ultrasound.aperture_paths import over_aperture
from twin.ultrasound.beam import beam
from twin.ultrasound.echo_solids import Body, Wire, solid
from twin.ultrasound.medium import scatter
from twin.ultrasound.sound_paths import Paths, follow
from twin.ultrasound.surface_echoes import wire_echoes
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

PEER = Path(__file__).resolve().with_name("kwave_peer.json")
WIDE_MM = 200.0  # of media without an end along the array
ACROSS_MM = 16.0  # of those without one across the plane
NEAR_MM, BESIDE_MM = 1.5, 2.5  # of a point, where it is looked for
LINE_MM, ROW_MM = 0.1, 0.05  # between lines and rows


def peer() -> dict:
    """k-Wave's figures, with its media and array."""
    return json.loads(PEER.read_text(encoding="utf-8"))


def array(rays: int, deep_mm: float = 24.0, flat: bool = False) -> Transducer:
    """The peer's array, with a number of rays over the aperture; `flat` sends a flat wave."""
    theirs = peer()["array"]
    figures = {name: theirs[name] for name in ("frequency_mhz", "transmit_focus_mm", "transmit_f_number", "receive_f_number")}
    figures |= {"bandwidth": (theirs["bandwidth"],) * 2, "aperture_rays": rays, "band_loss": True}
    if flat:
        figures |= {"transmit_focus_mm": 1000.0, "transmit_f_number": 25.0}  # 40 mm wide
    return QUIET.model_copy(
        update=figures | {"image_size": (241, round(deep_mm / ROW_MM) + 1), "scale_mm_per_px": (LINE_MM, ROW_MM)}
    )


def fluid(speed: float, density: float, loss: float = 0.0, echogenicity: float | None = None) -> Tissue:
    """A medium of a speed, m/s, a density, kg/m3, and a loss, dB/cm/MHz."""
    return Tissue(1e-6 * speed * density, speed, loss, echogenicity)


@dataclass(frozen=True, eq=False)
class View:
    """A body under the array, with the ways of sound to all places, on which points are laid one at a time; see `view`."""

    body: Body
    transducer: Transducer
    pose: Array  # (4, 4) mm, world_from_image
    paths: Paths

    @property
    def places(self) -> Array:
        """Of the lines along the array : (w,) mm, 0 in its middle."""
        return LINE_MM * np.arange(self.transducer.image_size[0]) - self.transducer.width_mm / 2

    def point(self, aside: float, depth: float) -> Array:
        """Envelope : (rows, lines) of a small, smooth bead at a place, mm."""
        ends = np.array([[aside, -0.01, depth], [aside, 0.01, depth]])
        bead = Wire("bead", replace(TISSUES["steel"], roughness=0.0), ends, 0.01)
        spread, body = beam(self.transducer), replace(self.body, wires=(bead,))
        echoes = wire_echoes(body, self.transducer, spread, self.paths, self.pose, 1)
        return np.float64(bmode_image.envelope(echoes, self.transducer, spread, self.paths, np.random.default_rng(1)))

    def shown(self, aside: float, depth: float) -> tuple[float, float]:
        """Where a point is shown, mm: along the array and deep, by the greatest envelope."""
        envelope, rows = self.point(aside, depth), self.transducer.rows_mm
        near = np.abs(rows - depth) < NEAR_MM
        beside = np.abs(self.places - aside) < BESIDE_MM
        across = top(self.places[beside], envelope[near].max(axis=0)[beside])
        return across, top(rows[near], envelope[near][:, np.abs(self.places - across).argmin()])


def view(body: Body, transducer: Transducer) -> View:
    """Follow the ways of sound through a body under an array."""
    pose = looking_down(transducer)
    return View(body, transducer, pose, over_aperture(follow(body, transducer, pose), body, transducer, pose))


def top(places: Array, values: Array) -> float:
    """Place of the greatest value, through a cubic spline."""
    fine = np.linspace(places[0], places[-1], 20001)
    return float(fine[CubicSpline(places, values)(fine).argmax()])


def even_body(tissue: Tissue | None = None) -> Body:
    """The peer's even medium, or another."""
    return Body(tissue or fluid(peer()["speed"], peer()["density"]), (), ())


def layered_body() -> Body:
    """The peer's layers, as plates under the face, the last one the surroundings."""
    layers = peer()["layers"]
    start, plates = -10.0, []
    for k, (end, speed, density) in enumerate(layers[:-1]):
        mesh = shapes.plate((WIDE_MM, WIDE_MM), end - start)
        mesh.apply_translation([0, 0, start])
        plates.append(solid(Thing(f"plate{k}", mesh, Material(0.5)), fluid(speed, density), None))
        start = end
    return Body(fluid(*layers[-1][1:]), tuple(plates), ())


def slanted_body() -> Body:
    """Fat over gland, with a slanted border."""
    slant, thick = peer()["slant"], 25.0
    mesh = shapes.plate((60.0, ACROSS_MM), thick)
    mesh.apply_translation([0, 0, -thick])
    turn = np.deg2rad(slant["tilt_deg"])
    mesh.apply_transform(rigid.from_rotation_vector([0, -turn, 0], [0, 0, slant["depth_mm"]]))
    return Body(even_body().medium, (solid(Thing("fat", mesh, Material(0.5)), fluid(*peer()["fat"]), None),), ())


def lobule_body() -> Body:
    """A lobule of fat in gland: an ellipse in the image's plane."""
    (x, depth), (a, b) = peer()["lobule"]["middle_mm"], peer()["lobule"]["half_mm"]
    mesh = trimesh.creation.cylinder(radius=1.0, height=ACROSS_MM, sections=200)
    mesh.apply_transform([[a, 0, 0, x], [0, 0, 1, 0], [0, b, 0, depth], [0, 0, 0, 1]])
    mesh.fix_normals()
    return Body(even_body().medium, (solid(Thing("fat", mesh, Material(0.5)), fluid(*peer()["fat"]), None),), ())


def disc_body() -> Body:
    """A rod across the plane that absorbs, and differs in nothing else."""
    disc = peer()["disc"]
    depth, radius = disc["depth_mm"], disc["radius_mm"]
    lying = rigid.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, depth))
    thing = Thing("disc", shapes.moved(shapes.rod(radius, ACROSS_MM), lying), Material(0.5))
    form = Cylinder("disc", np.array([0.0, 0.0, depth]), np.array([0.0, 1.0, 0.0]), radius)
    dark = fluid(peer()["speed"], peer()["density"], disc["loss_db_per_cm_mhz"])
    return Body(even_body().medium, (solid(thing, dark, form),), ())


def delays(setup: Setup, rays: int) -> Figures:
    """How much deeper points under layers are shown than in an even medium; the worst difference from the peer."""
    theirs = peer()["delays"]
    layers, even = view(layered_body(), array(rays)), view(even_body(), array(rays))
    late = [layers.shown(0.0, row["depth_mm"])[1] - even.shown(0.0, row["depth_mm"])[1] for row in theirs]
    return worst("late", late, [row["late_mm"] for row in theirs])


def shifts(setup: Setup, rays: int, medium: str) -> Figures:
    """How far aside points are shown behind a slanted border or a lobule; the worst difference from the peer."""
    theirs = peer()[f"shifts_{medium}"]
    bent = view({"slant": slanted_body, "lobule": lobule_body}[medium](), array(rays))
    moved = [bent.shown(row["aside_mm"], row["depth_mm"])[0] - row["aside_mm"] for row in theirs]
    return worst("shift", moved, [row["shift_mm"] for row in theirs])


def worst(name: str, ours: list[float], theirs: list[float]) -> Figures:
    """Relative differences of lengths, the worst one in %, and all lengths in mm."""
    off = np.abs(np.array(ours) / np.array(theirs) - 1)
    each = {f"{name}{k}_mm": value for k, value in enumerate(ours)} | {f"peer{k}_mm": value for k, value in enumerate(theirs)}
    return {f"{name}_percent": 100 * float(off.max()), **each}


def shadow(setup: Setup, rays: int) -> Figures:
    """A shadow behind an absorbing disc: its width at half of the amplitude without it, of speckle and points, and its edge."""
    found, theirs = shadow_of(disc_body(), rays), peer()["shadow"]
    figures = {f"{name}_mm": value for name, value in found.items()} | {f"peer_{name}_mm": theirs[f"{name}_mm"] for name in found}
    return figures | {f"{name}_percent": 100 * abs(value / theirs[f"{name}_mm"] - 1) for name, value in found.items()}


def shadow_of(body: Body, rays: int) -> dict[str, float]:
    """Widths, mm, of the shadow that a body throws on the peer's points, and of its edge, a quarter to three quarters."""
    places, lines, depth = (np.array(peer()["shadow"][name]) for name in ("points_mm", "lines_mm", "depth_mm"))
    powers, peaks = [], []
    for seen in (view(body, array(rays)), view(even_body(), array(rays))):
        near = np.abs(seen.transducer.rows_mm - depth) < 1.2
        echoes = [seen.point(place, float(depth))[near] for place in places]
        energy = [(echo**2).sum(axis=0) for echo in echoes]
        powers.append(np.interp(lines, seen.places, energy[0] + sum(one + one[::-1] for one in energy[1:])))
        peaks.append([echo.max() for echo in echoes])
    speckle, points = np.sqrt(powers[0] / powers[1]), np.array(peaks[0]) / peaks[1]
    quarter, half, most = (float(value) for value in np.interp([0.25, 0.5, 0.75], speckle, lines))
    return {"speckle_width": 2 * half, "speckle_edge": most - quarter, "points_width": 2 * float(np.interp(0.5, points, places))}


def losses(setup: Setup, rays: int) -> Figures:
    """Attenuation's slope, dB/cm: of a point's greatest envelope over the depths of the peer's points."""
    found, theirs, deep = losses_at(rays, peer()["loss_db_per_cm_mhz"])
    slopes = [np.polyfit(0.1 * deep, values, 1)[0] for values in (found, theirs)]
    return {
        "slope_percent": 100 * abs(slopes[0] / slopes[1] - 1),
        "slope_db": slopes[0],
        "peer_slope_db": slopes[1],
        "deepest_db": found[-1],
        "peer_deepest_db": theirs[-1],
    }


def losses_at(rays: int, loss: float) -> tuple[Array, Array, Array]:
    """Losses, dB, of points at depths in the twin and by the peer, and the depths, mm."""
    rows = peer()["losses"]
    scanner = array(rays, deep_mm=38.0)
    clear, lossy = view(even_body(), scanner), view(even_body(fluid(peer()["speed"], peer()["density"], loss)), scanner)
    ratio = [clear.point(0.0, row["depth_mm"]).max() / lossy.point(0.0, row["depth_mm"]).max() for row in rows]
    return 20 * np.log10(ratio), np.array([row["loss_db"] for row in rows]), np.array([row["depth_mm"] for row in rows])


def speckle(setup: Setup, seeds: int) -> Figures:
    """Width of speckle's complex autocorrelation, along the array and in depth, of a flat and of a focused transmitted wave."""
    flat = peer()["speckle_flat"]
    rows = [(True, flat, (flat["near_mm"], flat["far_mm"]))]
    rows += [(False, row, (row["depth_mm"] - 2.0, row["depth_mm"] + 2.0)) for row in peer()["speckle_focused"]]
    figures: dict[str, float] = {}
    for flat_wave, theirs, window in rows:
        found = speckle_widths(array(1, flat=flat_wave), window, seeds)
        kind = "flat" if flat_wave else "focused"
        for name, value in found.items():
            off = f"{kind}_{name}_percent"
            figures[off] = max(figures.get(off, 0.0), 100 * abs(value / theirs[f"{name}_mm"] - 1))
            figures[f"{kind}_{name}{theirs.get('depth_mm', '')}_mm"] = value
    return figures


def speckle_widths(scanner: Transducer, window: tuple[float, float], seeds: int) -> dict[str, float]:
    """Full widths at half maximum, mm, of the complex autocorrelation's magnitude in a window of depths."""
    body, pose, spread = even_body(replace(even_body().medium, echogenicity=0.0)), looking_down(scanner), beam(scanner)
    rows = (scanner.rows_mm >= window[0]) & (scanner.rows_mm < window[1])
    paths = follow(body, scanner, pose)
    fields = [bmode_image.focused(scatter(body, scanner, spread, paths, pose, seed), spread)[rows] for seed in range(seeds)]
    speck = np.stack(fields)
    speck = speck / np.sqrt((np.abs(speck) ** 2).mean(axis=(0, 2)))[:, None]
    along, down = scanner.scale_mm_per_px
    return {"lateral": autocorrelation(speck, along), "axial": autocorrelation(np.swapaxes(speck, 1, 2), down)}


def autocorrelation(fields: NDArray[np.complex64], step_mm: float) -> float:
    """Full width at half maximum, mm, of the complex autocorrelation's magnitude along the last axis of fields : (n, m, k)."""
    count = fields.shape[-1]
    lags = range(min(round(4.0 / step_mm), count - 1))
    shared = np.abs([np.vdot(fields[..., : count - lag], fields[..., lag:]) / (count - lag) for lag in lags])
    places = step_mm * np.arange(len(shared))
    return width(np.r_[-places[:0:-1], places], np.r_[shared[:0:-1], shared])
