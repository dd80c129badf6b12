"""One picture with a B-scan of each kind of thing, or of several patients, for comparison with published B-scans.

python -m twin.ultrasound.gallery docs/images/bscans.png
python -m twin.ultrasound.gallery --patients conf/ultrasound/clinic.yaml docs/images/patients.jpg
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from recon.geometry import rigid
from scenes.anatomy import GLANDULAR
from scenes.catalogue import build_scene
from twin.living.living_body import Living, LivingBody, LivingSweep
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import Hand, Hold, resting
from twin.ultrasound.sweep_session import surface_of
from twin.ultrasound.transducer import Transducer

STILL = Hand(shift_mm=0, turn_deg=0)
TISSUE = Transducer()
WATER = Transducer(tgc_db_per_cm_mhz=0.0165, gain_db=-40.0)  # conf/ultrasound/water.yaml
MASSES = {"27 mm": (-10.0, -8.0), "14 mm": (28.0, -24.0), "12 mm": (26.0, 26.0)}  # x, y of the breast's tumours
PATIENTS = {  # x, y by title, by the gland's density
    "fatty": {"spiculated mass": (-12.0, -10.0), "to the rib": (-45.0, 10.0)},
    "scattered": {"cyst": (32.0, -27.0), "ligaments": (0.0, -42.0)},
    "heterogeneous": {"lobulated mass": (29.0, 29.0), "spiculated mass": (-12.0, -10.0)},
    "dense": {"cyst": (32.0, -27.0), "gland": (-30.0, 20.0)},
}
STATIONS = (  # title, scene, array, face in the world, direction of the array
    ("crossed wires, water", "crosswire", WATER, (4.0, -2.0, 635.0), (1, 0, 0)),
    ("rod of 15.82 mm, water", "inner_cylinder", WATER, (4.0, -2.0, 645.0), (0, 1, 0)),
    ("plate of 10 mm, water", "tank", WATER, (4.0, -2.0, 680.0), (1, 0, 0)),
    ("rod in gelatin", "cylinders", TISSUE, (4.0, -2.0, 640.0), (0, 1, 0)),
    ("test object", "test_object", TISSUE, (4.0, -2.0, 650.0), (1, 0, 0)),
)


def _bscans() -> dict[str, NDArray[np.uint8]]:
    """B-scans by title: the breast over its three tumours, wires, rods, a plate, the test object."""
    breast = body(build_scene({"kind": "breast"}))
    images = {}
    for size, (x, y) in MASSES.items():
        pose = resting(Hold(place_mm=(x, y), hand=STILL), surface_of("breast", breast), TISSUE, 1).poses[0]
        images[f"breast, tumour of {size}"] = scan(breast, TISSUE, pose, 1).image
    for title, kind, array, face, along in STATIONS:
        axes = np.column_stack([along, [0, 0, 1], np.cross(along, [0, 0, 1])])
        pose = rigid.transform(axes, face) @ rigid.transform(np.eye(3), (-array.face_mm[0], -array.face_mm[1], 0))
        images[title] = scan(body(build_scene({"kind": kind})), array, pose, 1).image
    return images


def _patients(scanner: Path) -> dict[str, NDArray[np.uint8]]:
    """B-scans of breasts of all densities, and of masses, by title, as a scanner shows them that is pressed in by 4 mm."""
    array, images = Transducer(**yaml.safe_load(scanner.read_text(encoding="utf-8"))), {}
    for seed, density in enumerate(GLANDULAR):
        breast = body(build_scene({"kind": "patient", "seed": 7 + seed, "anatomy": {"density": density}}))
        patient = LivingBody(Living(yields=True, element_mm=5.0), breast, surface_of("breast", breast), (0.0, 0.0))
        for title, (x, y) in PATIENTS[density].items():
            held = resting(Hold(place_mm=(x, y), hand=STILL, standoff_mm=-4.0), patient.surface, array, 1)
            field = LivingSweep(patient, array, held).field(0, held.poses[0])
            images[f"{density}, {title}"] = scan(breast.displaced(field), array, held.poses[0], 7 + seed).image
    return images


def _sheet(images: dict[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Images of one size, each under its title, in rows of `COLUMNS`."""
    tiles = []
    gap_px, title_px = 6, 22
    for title, image in images.items():
        tile = cv2.copyMakeBorder(image, title_px, gap_px, gap_px, gap_px, cv2.BORDER_CONSTANT, value=255)
        tiles.append(cv2.putText(tile, title, (gap_px, title_px - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 0, 1, cv2.LINE_AA))
    columns = 4
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)])


def main() -> None:
    """Write the sheet, at half its size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--patients", type=Path, metavar="SCANNER", help="patients as a scanner shows them, instead of phantoms")
    parser.add_argument("picture", type=Path)
    given = parser.parse_args()
    picture = _sheet(_patients(given.patients) if given.patients else _bscans())
    scale = 0.75 if given.patients else 0.5
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    packing = [cv2.IMWRITE_JPEG_QUALITY, 85] if given.picture.suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    cv2.imwrite(str(given.picture), small, packing)


if __name__ == "__main__":
    main()
