"""Takes for the tests: a plain, clean target over empty surroundings, in even light."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
import yaml

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import Rig, Target
from scenes.handheld import lofts
from scenes.handheld.mesh_parts import Part
from twin.tracking.samples import LAMPS, Lighting, Motion, Print, Take, draw
from twin.tracking.sampling_ranges import DataRanges

CONF = Path(__file__).parents[3] / "conf"


def rig() -> Rig:
    return Rig(**yaml.safe_load((CONF / "rig/meza2021.yaml").read_text()))


def ranges(**changes) -> DataRanges:
    settings = yaml.safe_load((CONF / "dataset.yaml").read_text())["ranges"]
    return DataRanges(**{**settings, "variants": 2, **changes})


def facing(tilt_deg: float = 20.0, place=(30.0, -20.0, 650.0), turn_deg: float = 30.0) -> np.ndarray:
    """`world_from_target` of a target that faces camera 1 but for a tilt about the image's vertical."""
    towards = rigid.from_rotation_vector([np.pi, 0, 0], place)
    return (
        towards
        @ rigid.from_rotation_vector([0, 0, np.deg2rad(turn_deg)], [0] * 3)
        @ rigid.from_rotation_vector([0, np.deg2rad(tilt_deg), 0], [0] * 3)
    )


def plain_take(pose: np.ndarray, *, shift_mm=(0, 0, 0), turn_rad=(0, 0, 0), k: int = 0, white_dn: float = 100.0) -> Take:
    """The rig's own cameras, light from all around alone, a perfect print, and the surroundings far below."""
    described = rig()
    drawn = draw(ranges(), described, 0, k)
    lamps = np.zeros((LAMPS, 5))
    lamps[:, 3] = 1
    far = rigid.invert(rigid.from_rotation_vector([np.pi, 0, 0], [0, 0, 3000]))
    return replace(
        drawn,
        cameras=(described.cam1, described.cam2),
        present=True,
        motion=Motion(pose, np.array(shift_mm, float), np.array(turn_rad, float)),
        lighting=Lighting(lamps, 1 / np.pi, np.zeros(3), np.array([0, 1, 0, 12, 0.0])),
        scene_from_world=far,
        face=Print(0.03, 0.8, 0.0, 0.0, np.zeros((3, 6)), np.zeros((4, 4))),
        white_dn=white_dn,
        gain=1.0,
    )


def rig_of_three() -> Rig:
    """The rig with a needle and a patient beside the probe."""
    bodies = {name: yaml.safe_load((CONF / f"target/{name}.yaml").read_text()) for name in ("needle", "patient")}
    return Rig(**{**yaml.safe_load((CONF / "rig/meza2021.yaml").read_text()), "bodies": bodies})


def bare_board(target: Target) -> list[Part]:
    """The target's board, 3 mm thick and nothing else."""
    half, middle = np.array(target.board_mm) / 2, circle_layout.middle(target)[:2]
    corners = np.column_stack([middle + half * [[-1, -1], [1, -1], [1, 1], [-1, 1]], np.zeros(4)])
    front = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    solid = lofts.box([*target.board_mm, 2.95], [*middle, -1.525])
    return [Part("target", front, False), Part("board", solid, False)]
