"""The B-mode model's figures: speed, speckle, point spread, contrast, each beside what theory says.

python -m benchmarks.ultrasound [--pictures FOLDER]
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.integrate import quad
from scipy.optimize import root_scalar

from recon import rigid
from scenes.acoustics import TISSUES, Tissue
from scenes.catalogue import build_scene
from twin.ultrasound import image
from twin.ultrasound.beam import beam
from twin.ultrasound.medium import scatter
from twin.ultrasound.paths import follow
from twin.ultrasound.probe_path import Hand, SurfacePath, along_surface
from twin.ultrasound.scan import scan
from twin.ultrasound.solids import Body, Wire, body
from twin.ultrasound.transducer import Transducer

ROOT = Path(__file__).resolve().parent.parent
QUIET = {"noise_db": -200.0, "face_ring_mm": 0.0, "reverberations": 0, "tgc_db_per_cm_mhz": 0.0}
REFERENCE = Body(Tissue(1.6, 1540.0, 0.0, 0.0), (), ())


def transducer(name: str, **changes) -> Transducer:
    fields = yaml.safe_load((ROOT / "conf" / "ultrasound" / f"{name}.yaml").read_text(encoding="utf-8"))
    return Transducer(**(fields | changes))


def looking_down(
    array: Transducer, face: tuple[float, float, float], along: tuple[float, float, float] = (1, 0, 0)
) -> np.ndarray:
    """A pose along the world's z, its array along x or y, its middle at `face`."""
    axes = np.column_stack([along, [0, 0, 1], np.cross(along, [0, 0, 1])])
    return rigid.transform(axes, face) @ rigid.transform(np.eye(3), (-array.width_mm / 2, 0, 0))


def speckle(array: Transducer) -> dict[str, str]:
    envelope = np.stack([scan(REFERENCE, array, looking_down(array, (0, 0, 0)), seed).envelope[80:] for seed in range(4)])
    return {"speckle SNR, theory 1.91": f"{envelope.mean() / envelope.std():.3f}"}


def decorrelation(array: Transducer) -> dict[str, str]:
    """At the lens's focus, against the transform of the squared triangle [Wagner et al. 1988, van Cittert and Zernike]."""
    spread, rows, result = beam(array), np.abs(array.rows_mm - array.elevation_focus_mm) < 3, {}

    def echoes(y):
        pose = looking_down(array, (0, y, 0))
        return image.focused(scatter(REFERENCE, array, spread, follow(REFERENCE, array, pose), pose, 1), spread)[rows]

    still = echoes(0.0)
    for moved in (0.2, 0.4, 0.6, 0.8):
        other = echoes(moved)
        found = abs(np.vdot(still, other)) / np.sqrt(np.vdot(still, still).real * np.vdot(other, other).real)
        turns = 2 * np.pi * moved * array.elevation_mm / (array.wavelength_mm * array.elevation_focus_mm)
        theory = 3 * quad(lambda u, turns=turns: (1 - u) ** 2 * np.cos(turns * u), 0, 1)[0]
        result[f"correlation after {moved} mm across the plane, theory {theory:.3f}"] = f"{found:.3f}"
    return result


def widths(array: Transducer) -> dict[str, str]:
    """Of a filament, at half amplitude along the array; diffraction of two Hann apertures where both are in focus."""
    result = {}
    for depth in (5.0, 15.0, 25.0, 35.0, 45.0):
        wire = Wire("wire", TISSUES["steel"], np.array([[0, -20, depth], [0, 20, depth]]), 0.01)
        made = Body(Tissue(1.5, 1540.0, 0.0, None), (), (wire,))
        envelope = scan(made, array, looking_down(array, (0, 0, 0)), 1).envelope
        profile = envelope[envelope.max(axis=1).argmax()]
        above = np.flatnonzero(profile > profile.max() / 2)
        first, last = above[0], above[-1]
        half = profile.max() / 2
        width = last - first + (profile[first] - half) / (profile[first] - profile[first - 1])
        width = (width + (profile[last] - half) / (profile[last] - profile[last + 1])) * array.scale_mm_per_px[0]
        note = f", diffraction {diffraction(array):.3f}" if depth == array.transmit_focus_mm else ""
        result[f"width at {depth:g} mm{note}"] = f"{width:.3f} mm"
    return result


def diffraction(array: Transducer) -> float:
    depth = array.transmit_focus_mm
    apertures = depth / array.transmit_f_number, min(depth / array.receive_f_number, array.aperture_mm)

    def excess(x):
        turns = [x * aperture / (array.wavelength_mm * depth) for aperture in apertures]
        return np.prod([np.sinc(u) / (1 - u**2) for u in turns]) - 0.5

    return 2 * root_scalar(excess, bracket=(0.05, 0.9)).root


def speed(frames: int = 30) -> dict[str, str]:
    """Frames a second of the breast on the path of a stroke, everything on."""
    array = transducer("linear")
    made = body(build_scene({"kind": "breast"}))
    skin = next(one for one in made.solids if one.name == "breast")
    path = along_surface(SurfacePath(start_mm=(-10, -20), end_mm=(-10, 10), speed_mm_s=30, hand=Hand()), skin, array, 1)
    poses = path.poses[np.linspace(0, len(path.poses) - 1, frames).astype(int)]
    scan(made, array, poses[0], 1)
    start = time.perf_counter()
    for frame, pose in enumerate(poses):
        scan(made, array, pose, 1, frame)
    return {"breast, frames a second (aim 10)": f"{frames / (time.perf_counter() - start):.1f}"}


def pictures(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    tissue, water = transducer("linear"), transducer("water")
    for name, array, face, along in (
        ("test_object", tissue, (4, -2, 650), (1, 0, 0)),
        ("crosswire", water, (4, -2, 635), (1, 0, 0)),
        ("inner_cylinder", water, (4, -2, 645), (0, 1, 0)),
        ("tank", water, (4, -2, 680), (1, 0, 0)),
        ("cylinders", tissue, (4, -2, 640), (0, 1, 0)),
    ):
        made = scan(body(build_scene({"kind": name})), array, looking_down(array, face, along), 1)
        cv2.imwrite(str(folder / f"{name}.png"), made.image)
    made = body(build_scene({"kind": "breast"}))
    skin = next(one for one in made.solids if one.name == "breast")
    for k, (x, y) in enumerate(((-10, -8), (28, -24), (26, 26))):
        stroke = SurfacePath(start_mm=(x, y), end_mm=(x + 0.5, y), hand=Hand(shift_mm=0, turn_deg=0))
        pose = along_surface(stroke, skin, tissue, 1).poses[0]
        cv2.imwrite(str(folder / f"breast{k}.png"), scan(made, tissue, pose, 1).image)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=Path)
    folder = parser.parse_args().pictures
    array = transducer("linear", **QUIET)
    for name, value in (speckle(array) | decorrelation(array) | widths(array) | speed()).items():
        print(f"{name:60} {value}")
    if folder:
        pictures(folder)


if __name__ == "__main__":
    main()
