"""Time that a person with the board waits: from a sighting to its verdict and the next pose."""

from recon.model.rig import Rig
from sonotwin.config import compose
from twin.conditions import BoardPrint
from twin.experiments.live_poses_accuracy import GUIDED, Session, guided
from twin.experiments.table_rows import Measurement, Row

WAIT_S = 0.5


def measurements() -> list[Measurement]:
    """The rows of the part."""
    return [waiting]


def waiting() -> list[Row]:
    """Row g: the longest wait of a session; compiled code is there from the first pose on."""
    rig = Rig.model_validate(compose("render", ["out=unused"])["rig"])
    seconds = guided(Session(rig, BoardPrint(), seed=0)).seconds[1:]
    what = f"{GUIDED} guided poses, three devices: from a sighting to verdict and next pose"
    return [Row("g", f"{what}, the longest", max(seconds), WAIT_S, None, "s")]
