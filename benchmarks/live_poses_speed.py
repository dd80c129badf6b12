"""Time that a person with the board waits: from a sighting to its verdict and the next pose."""

from twin.conditions import BoardPrint
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.live_poses_accuracy import GUIDED, Session, guided


def waiting(setup: Setup) -> Figures:
    """The longest wait of a session; compiled code is there from the first pose on."""
    return {"poses": GUIDED, "longest_s": max(guided(Session(setup.rig, BoardPrint(), seed=0)).seconds[1:])}
