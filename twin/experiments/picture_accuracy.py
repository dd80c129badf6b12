"""Realism of B-scans: figures of a grown breast's pictures beside those of recorded ones.

The recordings' figures are kept in `recorded_pictures.json` beside this module, so that they count as its code; images of others
aren't.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from recon.geometry import rigid
from scenes.catalogue import build_scene
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.picture_figures import PictureFigures, divergence, measure
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import Hand, Hold, resting
from twin.ultrasound.sweep_session import surface_of
from twin.ultrasound.transducer import Transducer

RECORDED = Path(__file__).resolve().with_name("recorded_pictures.json")
PLACES = ((-12.0, -10.0), (28.0, -20.0), (26.0, 20.0), (-30.0, 20.0), (0.0, -40.0), (-50.0, 0.0))  # x, y mm in the world
STILL = Hand(shift_mm=0, turn_deg=0)


def recorded() -> dict[str, dict]:
    """Figures of the recorded images, by the recordings' name."""
    return json.loads(RECORDED.read_text(encoding="utf-8"))


def realism(setup: Setup, scanner: str, seeds: Sequence[int], beside: Sequence[str]) -> Figures:
    """Medians of rendered pictures over those of recorded ones, off from 1 in %, and the divergence of the greys, bits."""
    array = setup.scanners[scanner]
    pictures = [figures for seed in seeds for figures in views(array, seed)]
    medians = {name: float(np.nanmedian([getattr(one, name) for one in pictures])) for name in PictureFigures._fields[:-1]}
    histogram = np.mean([picture.histogram for picture in pictures], axis=0)
    found: Figures = {"images": len(pictures)} | {f"{name}_ours": value for name, value in medians.items()}
    for name in beside:
        theirs = recorded()[name]
        found |= {f"{name}_images": theirs["images"]}
        found |= {f"{name}_{of}_percent": 100 * abs(medians[of] / row["median"] - 1) for of, row in theirs["figures"].items()}
        found |= {f"{name}_divergence_bits": divergence(histogram, np.array(theirs["histogram"]))}
    return found


def views(array: Transducer, seed: int) -> list[PictureFigures]:
    """Figures of some B-scans of a patient of a seed."""
    breast = body(build_scene({"kind": "patient", "seed": seed, "edge_mm": 1.5}))
    skin, found = surface_of("breast", breast), []
    for number, (x, y) in enumerate(PLACES):
        pose = resting(Hold(place_mm=(x, y), hand=STILL), skin, array, 1).poses[0]
        turned = pose @ rigid.transform(np.eye(3), (0, 0, 0.1 * seed))
        found.append(measure(scan(breast, array, turned, seed, number).image, array.scale_mm_per_px))
    return found
