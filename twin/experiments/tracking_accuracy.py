"""Accuracy of tracking: detection rates, circles' centres, poses, and rivals."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from recon.model.rig import Target
from recon.tracking import networks as nets
from recon.tracking import photographs
from recon.tracking.networks import Networks
from twin.experiments import detection_rates, pose_accuracy, rivals, tracking_reach
from twin.experiments.table_rows import Measurement, Row, Setup

PHOTO = "tracking_photo/cam2.png"
# where the circles of the photograph are, read off by eye to about 1.5 px : c0, c1, c2
PHOTO_PX = np.array([[35.0, 137.0], [32.0, 164.0], [75.0, 138.0]])
BY_EYE_PX = 2.0


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group, at full size, with the weights that are shipped."""
    networks = nets.load()
    exact = setup.rig.target.model_copy(update={"tolerance_mm": 0.0})  # as it is rendered, to the last digit
    setup = replace(setup, rig=setup.rig.model_copy(update={"target": exact}))
    return [
        lambda: detection_rates.rows(setup, networks),
        lambda: tracking_reach.rows(setup, networks),
        lambda: pose_accuracy.centre_rows(setup, networks),
        lambda: pose_accuracy.pose_rows(setup, networks),
        lambda: rivals.rows(setup, networks),
        *([] if (real := setup.real) is None else [lambda: photograph_rows(real, setup.rig.target, networks)]),
    ]


def photograph_rows(real: Path, target: Target, networks: Networks) -> list[Row]:
    """Circles of a real photograph that are found at their places, under their names."""
    image = cv2.imread(str(real / PHOTO), cv2.IMREAD_GRAYSCALE)
    view = photographs.find(image, networks, target)
    away = np.linalg.norm(view.outlines.ellipses.centre - PHOTO_PX, axis=1)
    right = int((away < BY_EYE_PX).sum()) if view.found else 0
    return [Row("h", "circles of a real photograph, found with the right names", right, 3, 3, "circles", at_least=True)]
