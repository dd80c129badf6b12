"""A slider under a 3-D view, which leads a B-scan and the probe along the sweep."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.reports.space_views import Shape, Sheet

Array = NDArray[np.float64]

TEMPLATE = Path(__file__).parent / "player.html"


@dataclass(frozen=True, eq=False)
class Reel:
    """B-scans along a sweep, and the bodies that move with the probe."""

    sheet: str  # name of the B-scan in the view
    images: Sequence[NDArray[np.uint8]]  # n of (h, w)
    world_from_pixel: Array  # (n, 4, 4)
    bodies: Sequence[Shape]  # in the target's frame
    world_from_target: Array  # (n, 4, 4)
    labels: Sequence[str]  # of each B-scan

    def sheet_at(self, k: int) -> Sheet:
        """B-scan k where it lies."""
        return Sheet(self.sheet, self.images[k], self.world_from_pixel[k])

    def bodies_at(self, k: int) -> list[Shape]:
        """The bodies where they stand at B-scan k."""
        pose = self.world_from_target[k]
        return [
            Shape(each.name, each.vertices @ pose[:3, :3].T + pose[:3, 3], each.triangles, each.colour, each.opacity)
            for each in self.bodies
        ]

    @property
    def extent(self) -> Array:
        """Points : (m, 3) mm, the outermost of all that moves, so that a view needn't be scaled anew."""
        height, width = self.images[0].shape
        corners = np.array([[u, v, 0, 1] for u in (0, width) for v in (0, height)], float)
        places = [(self.world_from_pixel @ corners.T)[:, :3].transpose(0, 2, 1).reshape(-1, 3)]
        for body in self.bodies:
            low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
            box = np.array([[*corner, 1.0] for corner in np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T])
            places.append((self.world_from_target @ box.T)[:, :3].transpose(0, 2, 1).reshape(-1, 3))
        points = np.concatenate(places)
        return np.array(np.meshgrid(*zip(points.min(axis=0), points.max(axis=0), strict=True))).reshape(3, -1).T


def player(view: str, reel: Reel, first: int) -> str:
    """The slider, as HTML, for the view of this name on the page; it begins at B-scan `first`."""
    step_px = 3  # of a B-scan's pixels, for one of its picture in space
    thinned = np.stack([cv2.blur(image, (step_px, step_px))[::step_px, ::step_px] for image in reel.images])
    sheets = reel.world_from_pixel @ np.diag([step_px, step_px, 1, 1])
    content: Mapping[str, object] = {
        "sheet": reel.sheet,
        "rows": thinned.shape[1],
        "columns": thinned.shape[2],
        "greys": _pack(thinned),
        "sheets": _pack(np.float32(sheets[:, :3])),
        "bodies": [each.name for each in reel.bodies],
        "shapes": [_pack(np.float32(each.vertices)) for each in reel.bodies],
        "poses": _pack(np.float32(reel.world_from_target[:, :3])),
        "labels": list(reel.labels),
    }
    text = Template(TEMPLATE.read_text(encoding="utf-8"))
    packed = json.dumps(content).replace("</", "<\\/")
    return text.substitute(name=view, last=len(reel.images) - 1, first=first, reel=packed)


def _pack(values: NDArray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
