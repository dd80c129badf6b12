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


def draw(rng: np.random.Generator, present: bool, sizes: tuple[float, float]) -> tuple[np.ndarray, dict]:
    """A full frame seen from the front, so that circles stay circles, and its truth; `sizes` : least and most px a mm."""
    image = np.full(SIZE[::-1], rng.integers(20, 90), np.uint8)
    image = np.clip(image + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)
    nothing = {"visible": [0.0] * 3, "inside": [False] * 3, "blur_px": [0.0] * 3, "white_dn": None}
    truth = {"camera": {"size": SIZE}, "centres": None, "ellipses": None, **nothing}
    if present:
        scale, angle = rng.uniform(*sizes), rng.uniform(-np.pi, np.pi)
        c, s = np.cos(angle), np.sin(angle)
        turned = scale * np.array([[c, s], [s, -c]])  # seen from the front, v down: the cross product is negative
        shift = np.array([640, 512]) + rng.uniform(-200, 200, 2) - turned @ [12, 20]
        centres = CIRCLES @ turned.T + shift
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
    return image, truth


def _fixed(points: np.ndarray) -> np.ndarray:
    return np.rint(points * 2**FINER).astype(int)


def write_set(
    folder: Path, count: int, shard: int = 16, seed: int = 0, sizes: tuple[float, float] = (4.0, 6.5), first: int = 0
) -> Path:
    """Write a data set of `count` samples, every sixth without a target."""
    folder.mkdir(parents=True, exist_ok=True)
    for begin in range(first, first + count, shard):
        with tarfile.open(folder / f"shard-{begin // shard:05d}.tar", "w") as archive:
            for k in range(begin, min(begin + shard, first + count)):
                for name, content in members(np.random.default_rng([seed, k]), k, seed, sizes).items():
                    entry = tarfile.TarInfo(f"{seed}-{k:08d}.{name}")
                    entry.size = len(content)
                    archive.addfile(entry, io.BytesIO(content))
    (folder / "dataset.json").write_text(json.dumps({"version": 2, "first": first, "samples": count, "seed": seed}))
    return folder


def members(rng: np.random.Generator, k: int, seed: int, sizes: tuple[float, float]) -> dict[str, bytes]:
    """The files of one sample by the ends of their names."""
    present, views, files = k % 6 != 5, [], {}
    for camera in (1, 2):
        image, view = draw(rng, present, sizes)
        centres = rng.uniform(100, 900, (3, 2)) if view["centres"] is None else np.array(view["centres"])
        origins = np.clip(np.rint(centres).astype(int) - 59, 0, np.array(SIZE) - 120)
        view["patch_origins"] = origins.tolist()
        masks = [np.zeros_like(image) for _ in origins]  # of its own disc each: a neighbour may reach into the patch
        for mask, (u, v, a, _, _) in zip(masks, view["ellipses"] or [], strict=False):
            cv2.circle(mask, _fixed(np.array([u, v])), round(a * 2**FINER), 255, -1, shift=FINER)
        cut = [np.s_[v : v + 120, u : u + 120] for u, v in origins]
        for name, picture in (
            ("cam", cv2.resize(image, (320, 240))),
            ("patches", _stack([image] * 3, cut)),
            ("masks", _stack(masks, cut)),
        ):
            files[f"{name}{camera}.png"] = cv2.imencode(".png", picture)[1].tobytes()
        views.append(view)
    files["json"] = json.dumps({"k": k, "seed": seed, "present": present, "world_from_target": None, "views": views}).encode()
    return files


def _stack(images: list, cut: list) -> np.ndarray:
    return np.concatenate([image[one] for image, one in zip(images, cut, strict=True)])


@pytest.fixture(scope="session")
def data_set(tmp_path_factory) -> Path:
    """24 samples in two shards."""
    return write_set(tmp_path_factory.mktemp("drawn") / "set", 24)


@pytest.fixture
def write():
    """The writer of data sets."""
    return write_set
