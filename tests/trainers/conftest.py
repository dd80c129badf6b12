"""A data set of drawn targets, in the layout of `sonotwin dataset`."""

import io
import json
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest

SIZE, SCALE = (1280, 1024), np.array([4.0, 1024 / 240])
DISC, HOLE = 9.0, 3.6  # mm, radii
CIRCLES = np.array([[0.0, 0.0], [25.0, 0.0], [0.0, 40.0]])  # mm, c0, c1, c2
BOARD = np.array([[-15.0, -14.0], [39.0, -14.0], [39.0, 54.0], [-15.0, 54.0]])  # mm
FINER = 4  # subpixel bits of cv2's drawing


NEEDLE, TRAY = np.array([[0.0, 0.0], [32.0, 0.0], [0.0, 24.0]]), np.array([[0.0, 0.0], [22.0, 0.0], [0.0, 24.0], [22.0, 50.0]])
BODIES = {"needle": ("three_circles", NEEDLE), "tray": ("four", TRAY)}  # kinds of targets and circles, mm


def draw(rng: np.random.Generator, present: bool, sizes: tuple[float, float]) -> tuple[np.ndarray, dict]:
    """A full frame seen from the front, so that circles stay circles, and its truth; `sizes` : least and most px a mm."""
    image = np.full(SIZE[::-1], rng.integers(20, 90), np.uint8)
    image = np.clip(image + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)
    return image, {"camera": {"size": SIZE}, **paint(image, rng, present, sizes, CIRCLES, np.array([640, 512]), 200)}


def paint(
    image: np.ndarray, rng: np.random.Generator, present: bool, sizes: tuple, circles: np.ndarray, middle: np.ndarray, off: float
) -> dict:
    """Paint a board with circles : (n, 2) mm about a place, up to some px off; its truth."""
    n = len(circles)
    nothing = {"visible": [0.0] * n, "inside": [False] * n, "blur_px": [0.0] * n, "white_dn": None}
    truth = {"centres": None, "ellipses": None, **nothing}
    if present:
        scale, angle = rng.uniform(*sizes), rng.uniform(-np.pi, np.pi)
        c, s = np.cos(angle), np.sin(angle)
        turned = scale * np.array([[c, s], [s, -c]])  # seen from the front, v down: the cross product is negative
        shift = middle + rng.uniform(-off, off, 2) - turned @ [12, 20]
        centres = circles @ turned.T + shift
        white = int(rng.integers(120, 250))
        cv2.fillPoly(image, [_fixed(BOARD @ turned.T + shift)], white, cv2.LINE_AA, FINER)
        for centre in centres:
            for radius, grey in ((DISC, 15), (HOLE, white)):
                cv2.circle(image, _fixed(centre), round(scale * radius * 2**FINER), grey, -1, cv2.LINE_AA, FINER)
        inside = (np.abs(centres - [639.5, 511.5]) + scale * DISC < [640, 512]).all(1)
        truth |= {
            "centres": centres.tolist(),
            "visible": inside.astype(float).tolist(),
            "inside": inside.tolist(),
            "white_dn": white,
        }
        truth["ellipses"] = [[*centre, scale * DISC, scale * DISC, 0.0] for centre in centres]
    return truth


def _fixed(points: np.ndarray) -> np.ndarray:
    return np.rint(points * 2**FINER).astype(int)


def write_set(
    folder: Path,
    count: int,
    shard: int = 16,
    seed: int = 0,
    sizes: tuple[float, float] = (4.0, 6.5),
    first: int = 0,
    bodies: tuple[str, ...] = (),
) -> Path:
    """Write a data set of `count` samples, every sixth without a target, and with further bodies in all but every fifth."""
    folder.mkdir(parents=True, exist_ok=True)
    for begin in range(first, first + count, shard):
        with tarfile.open(folder / f"shard-{begin // shard:05d}.tar", "w") as archive:
            for k in range(begin, min(begin + shard, first + count)):
                for name, content in members(np.random.default_rng([seed, k]), k, seed, sizes, bodies).items():
                    entry = tarfile.TarInfo(f"{seed}-{k:08d}.{name}")
                    entry.size = len(content)
                    archive.addfile(entry, io.BytesIO(content))
    (folder / "dataset.json").write_text(json.dumps({"version": 2, "first": first, "samples": count, "seed": seed}))
    return folder


def members(
    rng: np.random.Generator, k: int, seed: int, sizes: tuple[float, float], bodies: tuple[str, ...] = ()
) -> dict[str, bytes]:
    """The files of one sample by the ends of their names."""
    present, views, others, files = k % 6 != 5, [], {name: [] for name in bodies}, {}
    for camera in (1, 2):
        image, view = draw(rng, present, sizes)
        for number, name in enumerate(bodies):
            middle = np.array([250 + 780 * number, 250])  # the probe's is painted first, and may be covered
            others[name].append(paint(image, rng, k % 5 != 4, (3.0, 4.0), BODIES[name][1], middle, 60))
        places = []
        for its, circles in ((view, CIRCLES), *((others[name][-1], BODIES[name][1]) for name in bodies)):
            centres = rng.uniform(100, 900, (len(circles), 2)) if its["centres"] is None else np.array(its["centres"])
            origins = np.clip(np.rint(centres).astype(int) - 59, 0, np.array(SIZE) - 120)
            its["patch_origins"] = origins.tolist()
            masks = [np.zeros_like(image) for _ in origins]  # of its own disc each: a neighbour may reach into the patch
            for mask, (u, v, a, _, _) in zip(masks, its["ellipses"] or [], strict=False):
                cv2.circle(mask, _fixed(np.array([u, v])), round(a * 2**FINER), 255, -1, shift=FINER)
            places += [(np.s_[v : v + 120, u : u + 120], mask) for (u, v), mask in zip(origins, masks, strict=True)]
        for name, picture in (
            ("cam", cv2.resize(image, (320, 240))),
            ("patches", np.concatenate([image[cut] for cut, _ in places])),
            ("masks", np.concatenate([mask[cut] for cut, mask in places])),
        ):
            files[f"{name}{camera}.png"] = cv2.imencode(".png", picture)[1].tobytes()
        views.append(view)
    truth = {"k": k, "seed": seed, "present": present, "world_from_target": None, "views": views}
    if bodies:
        truth["bodies"] = {name: {"kind": BODIES[name][0], "views": seen} for name, seen in others.items()}
    files["json"] = json.dumps(truth).encode()
    return files


@pytest.fixture(scope="session")
def data_set(tmp_path_factory) -> Path:
    """24 samples in two shards."""
    return write_set(tmp_path_factory.mktemp("drawn") / "set", 24)


@pytest.fixture(scope="session")
def set_of_bodies(tmp_path_factory) -> Path:
    """20 samples with a needle of the probe's kind of target, and a tray of another, of four circles."""
    return write_set(tmp_path_factory.mktemp("drawn") / "bodies", 20, bodies=("needle", "tray"))


@pytest.fixture
def write():
    """The writer of data sets."""
    return write_set
