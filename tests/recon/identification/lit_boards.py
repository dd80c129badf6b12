"""Boards in several poses, lit by the projector, as the twin's camera 1 sees them: rigs for tests, with their truth."""

from typing import NamedTuple

import numpy as np

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.boards import Discs
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from scenes import board_poses
from scenes.kinds import board
from tests.twin.small_rigs import half
from twin import board_session
from twin.board_session import Settings
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting, calibration_of
from twin.sensor import expose

GRAY = {"kind": "gray", "axis": "columns", "pitch": 1, "bits": 11, "inverted": True}
PATTERNS = Patterns.model_validate({"projector_size": (1280, 800), "unwrap": "gray", "parts": [GRAY]})  # none of them is shot


class Session(NamedTuple):
    """Images of a board in p poses."""

    images: list[np.ndarray]  # (p,) of (h, w) DN
    poses: rigid.Array  # (p, 4, 4) world_from_board
    board: Discs
    camera: Camera
    projector: Camera


def drawn(rig: Rig, rng: np.random.Generator) -> Rig:
    """The rig with another lens before camera 1 and another projector's vignetting; a camera of 640x512 px."""
    rig = half(rig)
    lens = rig.cam1.lens.model_copy(update={
        "f_number": rng.uniform(4, 11), "focus_mm": rng.uniform(450, 900), "blur_px": rng.uniform(0.3, 0.9),
        "vignetting": rng.uniform(0, 0.3),
    })  # fmt: skip
    shown = rig.projector.lens.model_copy(update={"vignetting": rng.uniform(0, 0.3)})
    return rig.model_copy(update={
        "cam1": rig.cam1.model_copy(update={"lens": lens}), "projector": rig.projector.model_copy(update={"lens": shown}),
    })  # fmt: skip


def shot(rig: Rig, count: int = 8, seed: int = 1, room_lux: float = 20.0, **printed) -> Session:
    """A board in `count` poses; `printed` are fields of `scenes.kinds.board.Config`."""
    settings = Settings(
        rig, board.Config(**printed), board_poses.Config(count=count, seed=seed, margin_px=4), PATTERNS, ("cam1",),
        Tracing(samples=16, room_lux=room_lux), Shooting(), seed=seed,
    )  # fmt: skip
    stage, poses, images = board_session.set_up(settings), board_session.place_all(settings), []
    optics, exposures = stage.cameras["cam1"], board_session.set_exposures(stage, settings)
    light = board_session.fully_on(stage.patterns)
    for k, pose in enumerate(poses):
        board_session.move_things(stage.world, stage.things, pose)
        radiance = board_session.trace_near(stage, optics, light, settings.tracing, 100 * seed + k)[0]
        board_session.refine_edges(radiance, stage, optics, settings.tracing.model_copy(update={"samples": 16}), pose, k)
        images.append(expose(radiance[None], rig.cam1, rig.projector.wavelength_nm, exposures["cam1"], 100 * seed + k)[0])
    cameras = calibration_of(rig).cameras
    return Session(images, poses, board.design(settings.board), cameras["cam1"], cameras["projector"])
