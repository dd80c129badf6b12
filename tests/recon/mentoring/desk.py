"""A mentor's desk for tests: skins, camera 1, and a site with a log."""

import numpy as np

from recon.files import meshes
from recon.geometry.camera import Camera
from recon.mentoring import drawing_log
from recon.mentoring.drawing_log import DrawingLog
from recon.mentoring.drawings import Drawings
from recon.mentoring.mentor_site import MentorSite
from recon.mentoring.sightings import Sighting
from tests.recon.skin_projection import skin_shapes

TOKENS = {"anna": "a" * 24, "bob": "b" * 24}


def camera() -> Camera:
    """Camera 1, with a lens that bends lines by some px."""
    matrix = np.array([[1600.0, 0, 320], [0, 1600, 256], [0, 0, 1]])
    return Camera((640, 512), matrix, np.array([-0.2, 0.1, 0.001, -0.002, 0]))


def sighting(number: int, world_from_skin=None, level: int = 90) -> Sighting:
    image = np.full((512, 640), level, np.uint8)
    return Sighting(number, 1_000_000 * number, image, np.eye(4) if world_from_skin is None else world_from_skin)


def lost(number: int, reason: str = "the patient isn't found: no circles") -> Sighting:
    return Sighting(number, 1_000_000 * number, np.full((512, 640), 20, np.uint8), None, reason)


def site(folder, skin=None, **others) -> MentorSite:
    """A site whose log and skin are in a folder."""
    skin = skin_shapes.plane(step=2.0) if skin is None else skin
    meshes.write_ply(folder / "skin.ply", skin)
    drawing_log.begin(folder / "log.jsonl", folder / "skin.ply")
    log = DrawingLog(folder / "log.jsonl")
    return MentorSite(skin, camera(), 8, Drawings(), log, TOKENS, **others)
