"""A small session drawn by hand: a sphere before a wall, by the geometry of rays alone: the twin's folders without a renderer."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.capture import calibration_files, writer
from recon.capture.manifest import Device
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.model.patterns import Fringes, Patterns
from scenes.board_poses import Config as Poses
from twin.experiments.experiment_runs import Settings

SHRINK = 4  # of camera 1: 320x256 px
CENTRE, RADIUS, WALL = np.array([4.0, -2.0, 650.0]), 19.8, 710.0  # mm
LIGHT, AMBIENT, NOISE = 150.0, 10.0, 1.0  # DN
NOTHING = 255
CONF = Path(__file__).resolve().parents[2] / "conf"
SHAPES = [
    {"kind": "sphere", "name": "ball", "centre": CENTRE.tolist(), "radius": RADIUS},
    {"kind": "plane", "name": "wall", "point": [0.0, 0.0, WALL], "normal": [0.0, 0.0, -1.0]},
]


@dataclass(frozen=True)
class Session:
    """Where the session is, and what it was drawn from."""

    folder: Path
    camera: Camera
    projector: Camera
    patterns: Patterns


@pytest.fixture(scope="module")
def session(rig, tmp_path_factory) -> Session:
    written = (CONF / "patterns" / "gray_surface.yaml").read_text(encoding="utf-8")
    patterns = Patterns.model_validate(yaml.safe_load(written))
    full, projector = rig.cam1.optics.camera(), rig.projector.optics.camera()
    shrink = np.diag([1 / SHRINK, 1 / SHRINK, 1.0])
    camera = replace(full, size=(full.size[0] // SHRINK, full.size[1] // SHRINK), matrix=shrink @ full.matrix)
    drawn = Session(tmp_path_factory.mktemp("session"), camera, projector, patterns)
    draw(drawn, np.random.default_rng(5))
    return drawn


def draw(session: Session, rng: np.random.Generator) -> None:
    """Write the session's truth/ and capture/."""
    camera, projector, patterns = session.camera, session.projector, session.patterns
    rays = camera.rays(camera.pixel_grid())
    to_ball = distance_to_ball(np.zeros(3), rays)
    on_ball = np.isfinite(to_ball)
    points = rays * np.where(on_ball, to_ball, WALL / rays[..., 2])[..., None]
    normals = np.where(on_ball[..., None], (points - CENTRE) / RADIUS, [0.0, 0.0, -1.0])
    light = points - projector.centre
    distance = np.linalg.norm(light, axis=-1)
    light /= distance[..., None]
    pixels = projector.project(points)
    inside = ((pixels > -0.5) & (pixels < np.array(projector.size) - 0.5)).all(axis=-1)
    shadowed = distance_to_ball(projector.centre, light) < distance - 1e-3
    lit = inside & ~shadowed & ((light * normals).sum(axis=-1) < 0)

    stack = []
    for axis, _, profile in patterns.profiles():
        x = pixels[..., 0 if axis == "columns" else 1]
        stack.append(AMBIENT + np.where(lit, LIGHT * np.interp(x, np.arange(len(profile)), profile), 0))
    images = np.clip(np.rint(np.array(stack) + NOISE * rng.standard_normal((len(stack), *lit.shape))), 0, 255).astype(np.uint8)

    fringes = next(part for part in patterns.parts if isinstance(part, Fringes))
    sigma = fringes.pitch / (2 * np.pi) * np.sqrt(2 / fringes.steps * (NOISE**2 + 1 / 12)) / (LIGHT / 2)
    truth = session.folder / "truth"
    for folder in ("surface", "calibration"):
        (truth / folder).mkdir(parents=True)
    optics = Calibration({"cam1": camera, "projector": projector})
    calibration_files.write(truth / "calibration" / "optics.yaml", optics)
    np.savez(
        truth / "surface" / "cam1.npz",
        points=np.float32(points),
        normals=np.float32(normals),
        objects=np.where(on_ball, 0, 1).astype(np.uint8),
        projector=np.float32(pixels),
        lit=lit,
        limit_px=np.where(lit[..., None], [sigma, np.inf], np.inf).astype(np.float32),  # no fringes along the rows
    )
    (truth / "scene.json").write_text(
        json.dumps({"name": "drawn", "things": ["ball", "wall"], "shapes": SHAPES}), encoding="utf-8"
    )
    devices = {
        "cam1": Device(size=camera.size, exposure_s=0.01, gain=1.0),
        "projector": Device(size=projector.size),
    }
    writer.write_surface(session.folder / "capture", {"cam1": images}, patterns, optics, devices, "drawn")


def distance_to_ball(start, directions):
    """Distance along rays to the ball's near side; inf where they miss it."""
    offset = start - CENTRE
    along = directions @ offset
    inner = along**2 - (offset @ offset - RADIUS**2)
    return np.where(inner > 0, -along - np.sqrt(np.maximum(inner, 0)), np.inf)


@pytest.fixture(scope="session")
def settings(rig, scanners) -> Settings:
    """The rig and the patterns of the paper, as in `conf/study.yaml`, and ten poses of the board."""
    places = ("dataset", "patterns/paper_surface", "patterns/paper_calibration")
    content = {name: yaml.safe_load((CONF / f"{name}.yaml").read_text(encoding="utf-8")) for name in places}
    patterns = {name: Patterns.model_validate(content[f"patterns/{name}"]) for name in ("paper_surface", "paper_calibration")}
    return Settings(
        rig=rig,
        patterns=patterns["paper_surface"],
        board_patterns=patterns["paper_calibration"],
        poses=Poses(count=10),
        ultrasound=scanners["water"],
        ranges=content["dataset"]["ranges"],
    )
