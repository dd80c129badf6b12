"""The target in a single image of any size: its circles, without a pose."""

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.model import circle_layout
from recon.model.rig import Target
from recon.tracking import circle_detector, circle_segmenter, identity, views
from recon.tracking.frames import grey
from recon.tracking.networks import Networks
from recon.tracking.rims import Outlines, measure, reach_px
from recon.tracking.views import View

TRIALS = 10  # namings of a level that are looked at
PRINTED = 0.25  # by which discs may be larger or smaller than the target's


def find(image: NDArray, networks: Networks, target: Target, bits: int | None = None) -> View:
    """Find the target's circles in an image of any size, colour and depth. Never raises on what it shows.

    The networks see it level by level, the whole first; circles may be as small as `circle_detector.LEAST_PX`.
    """
    try:
        image = grey(image, bits)
    except InputError as error:
        return views.nothing(str(error), circle_layout.count(target))
    count, likeliest = 0, None
    for windows in circle_detector.levels((image.shape[1], image.shape[0])):
        seen = circle_detector.detect([image] * len(windows), windows, networks)
        count += sum(len(candidates.points) for candidates in seen)
        choices = [
            naming for each, window in zip(seen, windows, strict=True) for naming in identity.namings(each, target, window.width)
        ]
        for naming in sorted(choices, key=lambda naming: -naming.score)[:TRIALS]:
            rough = circle_segmenter.rough_ellipses(image, naming.points, networks, target)
            outlines = measure(image, rough, reach_px(rough, circle_segmenter.OFF), target)
            outlines = views.renamed(outlines, target)
            view = views.judged(outlines, _as_printed(outlines, target))
            if view.found:
                return view
            likeliest = likeliest or view
    return likeliest or views.absent(count, circle_layout.count(target))


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
