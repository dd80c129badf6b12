"""B-scans of a filament phantom within its certificate, for each of which the probe is lifted and placed again."""

import numpy as np
from numpy.typing import NDArray

from recon.acceptance.certificates import FilamentCertificate
from recon.geometry import rigid
from scenes.catalogue import build_scene
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import body
from twin.ultrasound.transducer import Transducer

IMAGES = 5
LESS_DB = 20.0  # of gain than for tissue, as a person sets it for filaments, which are clipped else
PLACED_MM, PLACED_DEG = (1.5, 8.0), 1.5  # standard deviations of a hand: along the array and across it; tilt in the image's plane
TOP_MM = 650.0  # z of the phantom's face


def render(certificate: FilamentCertificate, scanner: Transducer, seed: int) -> list[NDArray[np.uint8]]:
    """B-scans (h, w) of a phantom of gelatin, its filaments drawn within their certificate."""
    rng = np.random.default_rng(seed)
    places = np.array(certificate.places_mm)
    drawn = places + certificate.expanded_mm / certificate.k / np.sqrt(2) / np.sqrt(2) * rng.standard_normal(places.shape)
    middle = (places[:, 0].min() + places[:, 0].max()) / 2
    bare = {"cysts": (), "bright": (), "dark": (), "middle_mm": (-middle, 0.0), "top_mm": TOP_MM, "size_mm": (80.0, 80.0, 60.0)}
    phantom = body(build_scene({"kind": "test_object", "filaments_mm": drawn.tolist(), **bare}))
    less = scanner.model_copy(update={"gain_db": scanner.gain_db - LESS_DB})
    images = []
    for number in range(IMAGES):
        (aside, across), tilt = PLACED_MM * rng.standard_normal(2), np.deg2rad(PLACED_DEG * rng.standard_normal())
        axes = np.column_stack([[np.cos(tilt), 0, np.sin(tilt)], [-np.sin(tilt), 0, np.cos(tilt)], [0, -1, 0]])
        face = rigid.transform(axes, (aside, across, TOP_MM))
        pose = face @ rigid.transform(np.eye(3), (-less.face_mm[0], -less.face_mm[1], 0.0))
        images.append(scan(phantom, less, pose, seed, number).image)
    return images
