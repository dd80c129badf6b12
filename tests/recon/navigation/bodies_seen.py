"""Results of a tracker of several bodies, at poses that are known."""

import numpy as np

from recon.geometry import rigid
from recon.tracking.pose_fit import TargetPose, lost
from recon.tracking.tracker import Tracking

OWN = np.diag([1e-8] * 3 + [1e-4] * 3)  # rad2 and mm2, of each pose
SHARED = np.diag([1e-9] * 3 + [4e-4] * 3)
PROBE = rigid.from_rotation_vector([2.8, 0.3, -0.4], [30, -12, 655])
NEEDLE = rigid.from_rotation_vector([3.0, -0.2, 0.5], [-60, 20, 640])
PATIENT = rigid.from_rotation_vector([3.1, 0.1, 0.1], [0, 70, 690])


def seen(pose, how="predicted"):
    """A body at a pose."""
    return Tracking(TargetPose(pose, OWN, 1.0, shared=SHARED), (), how)


def unseen(reason="camera 1: 2 of 3 circles"):
    """A body that isn't found."""
    return Tracking(lost(reason), ())


def three(**others):
    """Probe, needle and patient at their poses, but for others."""
    return {"probe": seen(PROBE), "needle": seen(NEEDLE), "patient": seen(PATIENT)} | others
