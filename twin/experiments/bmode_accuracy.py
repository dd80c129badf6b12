"""Accuracy of the B-mode model: against PyMUST, which follows every element of the array, and against diffraction.

PyMUST's figures are kept in `pymust_peer.json` beside this module, so that they count as its code, with the command that makes
them; it is no dependency.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from scenes import solid_meshes as shapes
from scenes.acoustics import TISSUES
from scenes.scene_types import Material, Thing
from scenes.tissue import Tissue
from twin.experiments.experiment_setup import Figures, Setup
from twin.ultrasound import bmode_image
from twin.ultrasound.beam import beam
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body, Wire, solid
from twin.ultrasound.medium import scatter
from twin.ultrasound.sound_paths import follow
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

PEER = Path(__file__).resolve().with_name("pymust_peer.json")
QUIET = Transducer(noise_db=-200.0, face_ring_mm=0.0, reverberations=0, tgc_db_per_cm_mhz=0.0)
REFERENCE = Tissue(1.6, 1540.0, 0.0, 0.0)
EMPTY = Tissue(1.5, 1540.0, 0.0, None)
SHIFTS_MM = (0.2, 0.4, 0.6, 0.8)
WINDOW_MM = 1.5  # on either side
LEAST = 0.2  # correlation, below which no relative error is taken


def peer() -> dict:
    """PyMUST's figures."""
    return json.loads(PEER.read_text(encoding="utf-8"))


def widths(setup: Setup, depths_mm: Sequence[float]) -> Figures:
    """Full widths at half maximum of a point's echo, worst difference from the peer of some of its depths."""
    theirs = [row for row in peer()["widths"] if row["depth_mm"] in depths_mm]
    ours = [point_widths(row["depth_mm"]) for row in theirs]
    return {
        f"{name}_percent": max(100 * abs(mine[name] / row[f"{name}_mm"] - 1) for mine, row in zip(ours, theirs, strict=True))
        for name in ("axial", "lateral", "elevational")
    }


def point_widths(depth: float) -> dict[str, float]:
    """Widths, mm, of a point's echo in depth, along the array and across the plane."""
    array = QUIET.model_copy(update={"image_size": (75, QUIET.image_size[1])})
    envelope = bead_echo(array, depth, 0.0)
    beside = array.scale_mm_per_px[0] * np.arange(array.image_size[0])
    offsets, levels = [], []
    for moved in array.scale_mm_per_px[1] / 4 * np.arange(4):  # rows are too far apart for so short a pulse
        column = bead_echo(array, depth + moved, 0.0)[:, array.image_size[0] // 2]
        offsets.append(array.rows_mm - depth - moved)
        levels.append(column)
    offset, level = np.concatenate(offsets), np.concatenate(levels)
    order = np.argsort(offset)
    near = order[np.abs(offset[order]) < 1.5]
    across = np.arange(0, 3.21, 0.1)
    peaks = np.array([bead_echo(array, depth, z).max() for z in across])
    return {
        "axial": width(offset[near], level[near]),
        "lateral": width(beside, envelope.max(axis=0)),
        "elevational": width(np.r_[-across[:0:-1], across], np.r_[peaks[:0:-1], peaks]),
    }


def bead_echo(array: Transducer, depth: float, across: float) -> Array:
    """Envelope : (h, w) of a smooth bead in a medium without echoes."""
    wire = Wire(
        "bead", replace(TISSUES["steel"], roughness=0.0), np.array([[0, across - 0.01, depth], [0, across + 0.01, depth]]), 0.01
    )
    return np.float64(scan(Body(EMPTY, (), (wire,)), array, looking_down(array), 1).envelope)


def width(places: Array, values: Array) -> float:
    """Full width at half maximum of a profile with one peak, through a cubic spline."""
    fine = np.linspace(places[0], places[-1], 20001)
    curve = CubicSpline(places, values)(fine)
    top = int(curve.argmax())
    low = curve < curve[top] / 2
    return float(fine[top + low[top:].argmax()] - fine[top - low[top::-1].argmax()])


def looking_down(array: Transducer, across: float = 0.0) -> Array:
    """A pose along the world's z, the array along x, its middle at (0, across, 0)."""
    upright = rigid.transform(np.column_stack([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), (0, across, 0))
    return upright @ rigid.transform(np.eye(3), (-array.width_mm / 2, 0, 0))


def speckle(setup: Setup) -> Figures:
    """Mean over standard deviation of the envelope; sqrt(pi / (4 - pi)) if fully developed."""
    body = Body(REFERENCE, (), ())
    envelope = np.stack([scan(body, QUIET, looking_down(QUIET), seed).envelope[80:] for seed in range(4)])
    found, theory = float(envelope.mean() / envelope.std()), np.sqrt(np.pi / (4 - np.pi))
    return {"ratio": found, "off": abs(found - theory), "peer_off": abs(peer()["block"]["speckle_snr"] - theory)}


def lesions(setup: Setup) -> Figures:
    """Power in a rod across the plane over that of the same place without it, and the peer's."""
    theirs = peer()["block"]
    found = contrast(theirs["lesion_echo_db"], theirs["depth_mm"], theirs["radius_mm"])
    void = contrast(None, theirs["depth_mm"], theirs["radius_mm"])
    own = {"contrast_db": found, "off_db": abs(found - theirs["lesion_db"]), "left_db": void, "peer_left_db": theirs["void_db"]}
    return own | {"diameter_mm": 2 * theirs["radius_mm"], "depth_mm": theirs["depth_mm"], "echo_db": theirs["lesion_echo_db"]}


def contrast(echogenicity: float | None, depth: float, radius: float) -> float:
    """Power, dB, in a rod across the plane over that of the same place without it."""
    pose = rigid.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, depth))
    thing = Thing("rod", shapes.moved(shapes.rod(radius, 30.0), pose), Material(0.5))
    form = Cylinder("rod", np.array([0.0, 0.0, depth]), np.array([0.0, 1.0, 0.0]), radius)
    tissue = replace(REFERENCE, echogenicity=echogenicity)
    bodies = Body(REFERENCE, (solid(thing, tissue, form),), ()), Body(REFERENCE, (), ())
    columns = QUIET.scale_mm_per_px[0] * np.arange(QUIET.image_size[0]) - QUIET.width_mm / 2
    inside = np.hypot(columns, QUIET.rows_mm[:, None] - depth) < 0.7 * radius
    power = [
        np.mean([(scan(body, QUIET, looking_down(QUIET), seed).envelope[inside] ** 2).mean() for seed in (1, 2)])
        for body in bodies
    ]
    return float(10 * np.log10(power[0] / power[1]))


def decorrelation(setup: Setup, depths_mm: Sequence[float], seeds: int) -> Figures:
    """Complex correlation of speckle before and after a step across the plane, against diffraction through the lens.

    The error is relative, the worst of all steps and depths at which theory has more than `LEAST`.
    """
    array = QUIET
    body, spread = Body(REFERENCE, (), ()), beam(array)
    rows = [np.abs(array.rows_mm - depth) < WINDOW_MM for depth in depths_mm]
    steps = np.r_[0.0, SHIFTS_MM]
    shared = np.zeros((len(depths_mm), len(steps)), complex)
    for seed in range(seeds):
        fields = []
        for across in np.concatenate([steps, SHIFTS_MM[-1] + steps[1:]]):
            pose = looking_down(array, across)
            fields.append(bmode_image.focused(scatter(body, array, spread, follow(body, array, pose), pose, seed), spread))
        for k, window in enumerate(rows):
            parts = np.stack([field[window].ravel() for field in fields])
            parts = parts / np.linalg.norm(parts, axis=1, keepdims=True)
            for lag in range(len(steps)):
                shared[k, lag] += (parts[: len(parts) - lag].conj() * parts[lag:]).sum(axis=1).mean()
    found = np.abs(shared) / seeds
    theory = np.array([[lens_correlation(array, depth, shift) for shift in steps] for depth in depths_mm])
    return {"error_percent": 100 * (np.abs(found - theory) / theory)[theory > LEAST].max()}


def lens_correlation(array: Transducer, depth: float, shift: float) -> float:
    """Correlation of speckle by a step across the plane: of the two-way fields, over the echo's band.

    Huygens' sum over the element's height with exact paths, where the twin has Fresnel's integrals and one pulse. Moving the
    probe moves its curved waves too, so that speckle decorrelates faster than van Cittert and Zernike's theorem has it of a fixed
    aperture.
    """
    near, far = array.bandwidth
    band = near + (far - near) * depth / array.depth_mm
    share = np.linspace(-1, 1, 15) * band
    height = array.elevation_mm * ((np.arange(160) + 0.5) / 160 - 0.5)
    places = np.arange(-5.0, 5.0 + shift, 0.02)
    path = np.hypot(depth, places[:, None] - height) - np.hypot(array.elevation_focus_mm, height)
    ahead = round(shift / 0.02)
    product, energy = 0j, 0.0
    for part in share:
        weight = np.exp(-8 * np.log(2) * (part / band) ** 2)
        two_way = np.exp(1j * array.wavenumber * (1 + part) * path).mean(axis=1) ** 2
        product += weight * np.vdot(two_way[: len(places) - ahead], two_way[ahead:])
        energy += weight * np.vdot(two_way, two_way).real
    return float(abs(product) / energy)
