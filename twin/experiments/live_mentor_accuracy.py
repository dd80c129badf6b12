"""Accuracy of what a mentor draws: strokes on camera 1's picture of the skin against the light that camera 1 then sees of them.

The whole way: a posted stroke, cast onto the measured skin; the projector's picture of it for the place of the skin by the
patient's target; that picture's light on the true skin, seen by camera 1; the light's middle on the true skin. The patient has
moved since the skin was measured, and goes on moving for as long as exposure, tracking, drawing and display take.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.files import meshes
from recon.geometry import rigid
from recon.mentoring import drawing_log
from recon.mentoring.drawing_log import DrawingLog
from recon.mentoring.drawings import Drawings
from recon.mentoring.mentor_site import MentorSite
from recon.mentoring.sightings import Sighting
from recon.model.rig import Rig
from recon.page_server import Request
from recon.skin_projection.live_picture import LivePicture
from scenes.catalogue import build_scene
from twin.evaluation import light_errors
from twin.evaluation.light_errors import LightErrors
from twin.experiments import live_skin_accuracy
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.live_skin_accuracy import BREAST, Spec
from twin.optics.ray_world import build_world
from twin.optics.surface_truth import surface_truth

Array = NDArray[np.float64]

FULL_PX = 1280  # width of the pictures in whose pixels strokes and smoothing are given
TURN = np.linspace(0, 2 * np.pi, 60)
STROKES = (  # (n, 2) px of camera 1's picture: a ring about the areola, a wave over the side, a straight line beyond
    np.column_stack([700 + 150 * np.cos(TURN), 480 + 130 * np.sin(TURN)]),
    np.column_stack([np.linspace(330, 500, 40), 560 + 40 * np.sin(np.linspace(0, 7, 40))]),
    np.array([[560.0, 760], [820, 720]]),
)
SHIFT_MM, TURN_DEG = (3.0, -2.0), 2.0  # of the patient, between the skin's measurement and the drawing
SPEED_MM_S = 10.0  # of the patient, along x, as breathing and shifting bodies have at most
LATENCY_S = (
    0.15  # from the exposure to the light: 0.01 s to memory, 0.03 to track, 0.02 to draw, 0.02 of display, 0.07 of projector
)
TARGET_MM = (-110.0, -20.0, 680.0)  # where the patient's target is
NOISE_RAD, NOISE_MM = (
    1e-4,
    0.02,
)  # of its pose, more than the median of the tracker's: a lever of 150 mm makes 0.015 mm of the turn
SEED = 43


def at_rest(setup: Setup) -> Figures:
    """Drawn and lit after the patient has moved, at rest."""
    return _figures(setup, 0.0, "rest")


def while_moving(setup: Setup) -> Figures:
    """The same of a patient who moves on meanwhile; `latency_mm` of it is the way in that time."""
    return _figures(setup, SPEED_MM_S * LATENCY_S, "moving") | {"latency_mm": SPEED_MM_S * LATENCY_S}


def _figures(setup: Setup, way_mm: float, name: str) -> Figures:
    errors = drawn(setup, live_skin_accuracy.measured(setup, BREAST), way_mm, name)
    return live_skin_accuracy.outlines(errors)


def drawn(setup: Setup, skin: trimesh.Trimesh, way_mm: float, name: str) -> LightErrors:
    """Draw on a picture, light it, and look at it by camera 1: distances of light on the skin from where it was drawn on it.

    Parameters
    ----------
    skin : as measured, of the breast where it was first
    way_mm : that the breast moves from the last picture of it to the light
    """
    rig, rng = setup.rig, np.random.default_rng(SEED)
    on_picture, in_light = shifted(0.0), shifted(way_mm)
    scale = rig.cam1.optics.size[0] / FULL_PX
    strokes = [scale * stroke for stroke in STROKES]
    moved, going_on = pose_between(BREAST, on_picture), pose_between(on_picture, in_light)
    drawings = posted(rig, skin, sighted(moved, rng), strokes)
    last_seen = sighted(moved, rng)
    image = LivePicture(skin, rig.projector.optics.camera(), rig.projector.gamma).draw(drawings.strips, last_seen)
    seen = live_skin_accuracy.photographed(rig, build_scene(in_light), image)
    if setup.out is not None:
        cv2.imwrite(str(setup.out / f"live_mentor_{name}.png"), seen)
    ridges = light_errors.ridges(seen, scale * live_skin_accuracy.RIDGE_PX)
    light = light_errors.in_space(ridges, true_points(rig, in_light))
    shown = true_points(rig, on_picture)
    meant = [light_errors.in_space(dense(stroke), shown) for stroke in strokes]
    return light_errors.compare(light, [rigid.apply(going_on, curve) for curve in meant])


def posted(rig: Rig, skin: trimesh.Trimesh, world_from_skin: Array, strokes: Sequence[Array]) -> Drawings:
    """What a mentor posts on a picture, as it is to be lit."""
    with TemporaryDirectory() as folder:
        log, file = Path(folder) / "log.jsonl", Path(folder) / "skin.ply"
        meshes.write_ply(file, skin)
        drawing_log.begin(log, file)
        drawings = Drawings()
        site = MentorSite(skin, rig.cam1.optics.camera(), 8, drawings, DrawingLog(log), {"mentor": "token"})
        site.offer(Sighting(1, 0, np.zeros(rig.cam1.optics.size[::-1], np.uint8), world_from_skin))
        site.answer(Request("GET", "/token/picture.jpg", "", "here", "", lambda most: b""))
        for stroke in strokes:
            post = json.dumps({"kind": "stroke", "picture": 1, "places": stroke.round(2).tolist()}).encode()
            site.answer(Request("POST", "/token/draw", "", "here", "application/json", lambda most, post=post: post))
        site.log.close()
        return drawings


def shifted(way_mm: float) -> Spec:
    """The breast after the patient's motion, and some mm farther along x."""
    first = (4.0, -2.0)  # the middle as it is without
    middle = [first[0] + SHIFT_MM[0] + way_mm, first[1] + SHIFT_MM[1]]
    return BREAST | {"middle_mm": middle, "turn_deg": TURN_DEG}


def pose_between(one: Spec, other: Spec) -> Array:
    """The rigid motion : (4, 4) of the breast from one scene to another, by the meshes' vertices [Kabsch 1976]."""
    first, then = (next(thing.mesh.vertices for thing in build_scene(scene).things if not thing.inside) for scene in (one, other))
    middle, aim = first.mean(axis=0), then.mean(axis=0)
    u, _, vt = np.linalg.svd((then - aim).T @ (first - middle))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return rigid.transform(turn, aim - turn @ middle)


def sighted(world_from_skin: Array, rng: np.random.Generator) -> Array:
    """A pose as the tracker gives it, by the target beside the breast."""
    target = rigid.transform(np.eye(3), TARGET_MM)
    noise = rigid.from_rotation_vector(rng.normal(0, NOISE_RAD, 3), rng.normal(0, NOISE_MM, 3))
    return world_from_skin @ target @ noise @ rigid.invert(target)


def true_points(rig: Rig, scene: Spec) -> NDArray[np.float32]:
    """The true surface at each pixel of camera 1 : (h, w, 3) mm."""
    return surface_truth(build_world(build_scene(scene)), rig.cam1.optics.camera(), rig.projector.optics.camera()).points


def dense(stroke: Array) -> Array:
    """A stroke's places : (n, 2) px, some to a pixel."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(stroke, axis=0), axis=1))])
    wanted = np.linspace(0, along[-1], 4 * int(along[-1]) + 2)
    return np.column_stack([np.interp(wanted, along, axis) for axis in stroke.T])
