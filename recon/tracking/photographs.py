"""The target in a single image of any size: its circles, without a pose."""

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry.ellipses import Ellipses
from recon.model.rig import Target
from recon.tracking import circle_detector, circle_segmenter, identity, views
from recon.tracking.frames import grey
from recon.tracking.networks import Networks
from recon.tracking.rims import Outlines, measure
from recon.tracking.views import View

FRAME = (1280, 1024)  # width, height, px, of the cameras that the networks know
ROUGH_PX = 5.0  # of such a frame
LEAST_REACH_PX = 2.0
PRINTED = 0.25  # by which discs may be larger or smaller than the target's


def find(image: NDArray, networks: Networks, target: Target, bits: int | None = None) -> View:
    """Find the target's circles in an image of any size, colour and depth. Never raises on what it shows.

    The networks see it at the size of a camera's frame, its border going on where the aspect differs; the target should take
    as much of it as in a camera's. Rims are fitted in the image itself.
    """
    try:
        image = grey(image, bits)
    except InputError as error:
        return views.nothing(str(error))
    frame, scale = _framed(image)
    candidates = circle_detector.detect([frame], networks)[0]
    choices = identity.triples(candidates, target, FRAME[0])
    result = views.nothing(f"{len(candidates.points)} places like circles, no three that lie like the target's")
    for triple in choices:
        rough = circle_segmenter.rough_ellipses(frame, triple.points, networks, target)
        back = Ellipses((rough.centre + 0.5) / scale - 0.5, rough.shape / scale)
        outlines = measure(image, back, max(ROUGH_PX / scale, LEAST_REACH_PX), target)
        outlines = views.renamed(outlines, target)
        view = views.judged(outlines, _as_printed(outlines, target))
        if view.found:
            return view
        result = view if triple is choices[0] else result
    return result


def _as_printed(outlines: Outlines, target: Target) -> Target:
    """The target with discs as large as they look beside their distances: how a photograph's was printed isn't known exactly."""
    affine = identity.affinity(outlines.ellipses.centre, target)
    with np.errstate(invalid="ignore"):
        expected = np.sqrt(np.abs(np.linalg.det(affine))) * target.outer_diameter_mm / 2
        ratio = np.median(np.sqrt(np.linalg.det(outlines.ellipses.shape))) / expected
    if not abs(ratio - 1) < PRINTED:
        return target
    sizes = {name: getattr(target, name) * float(ratio) for name in ("outer_diameter_mm", "inner_diameter_mm")}
    return target.model_copy(update=sizes)


def _framed(image: NDArray) -> tuple[NDArray, float]:
    """The image at a camera's size, and how many of its pixels one of the image's makes."""
    height, width = image.shape
    scale = min(FRAME[0] / width, FRAME[1] / height)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return np.ascontiguousarray(np.pad(scaled, ((0, FRAME[1] - size[1]), (0, FRAME[0] - size[0])), mode="edge")), scale
