"""Accuracy of tracking in a real photograph."""

import cv2
import numpy as np

from recon.tracking import networks as nets
from recon.tracking import photographs
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.tracking_frames import exactly_printed

PHOTO = "tracking_photo/cam2.png"
# where the circles of the photograph are, read off by eye to about 1.5 px : c0, c1, c2
PHOTO_PX = np.array([[35.0, 137.0], [32.0, 164.0], [75.0, 138.0]])
BY_EYE_PX = 2.0


def photograph(setup: Setup) -> Figures:
    """Circles of a real photograph that are found at their places, under their names."""
    assert setup.real is not None
    image = cv2.imread(str(setup.real / PHOTO), cv2.IMREAD_GRAYSCALE)
    view = photographs.find(image, nets.load(kind=setup.rig.target.kind), exactly_printed(setup).rig.target)
    away = np.linalg.norm(view.outlines.ellipses.centre - PHOTO_PX, axis=1)
    return {"right": (away < BY_EYE_PX).sum() if view.found else 0}
