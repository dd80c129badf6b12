"""Reconstruct all that a capture holds, from its images to masses under the skin, in one frame.

Reads a capture folder, recorded or rendered, and uses each part that is there: the board for the optics, fringes for the skin,
frames of both cameras for the poses of its sweeps, a flat bottom for the scanner's latency, crossed wires for the probe, B-scans
for volumes and masses. What is missing is taken from the calibrations given here or in the capture, or left out by name.

Writes into the folder `out`, each step in a folder of its own as its verb would: optics/, surface/, poses/NAME/, latency/,
probe/, volume/NAME/, masses/NAME/ or tube/NAME/, and scene/NAME/ (of a sweep without a name poses/, volume/ ...); and
metrics.json, the figures of all steps. A step whose result is there, made of the same, isn't done again, so a run that was killed
is simply started again. Takes minutes. Exit status 1 if a step failed, those that build on it are
left out, or if none could be done.

    sonotwin reconstruct capture=session/capture out=result
    sonotwin reconstruct capture=session/capture tissue_m_s=1450 temperature_c=22 out=result
    sonotwin reconstruct capture=session/capture calibration=optics.yaml probe=probe.yaml lag_s=0.05 out=result
"""

from pathlib import Path

from recon.files.code_digest import code_digest
from recon.session import optics_step, plan
from sonotwin import choices
from sonotwin.config import folder
from sonotwin.console_watch import ConsoleWatch
from sonotwin.verbs import calibrate_optics


class Config(plan.Settings):
    """Fields of `sonotwin reconstruct`: source, target, and what is known beforehand."""

    out: Path
    """folder; gets a folder a step, and metrics.json; what is there and made of the same is kept"""


def run(config: Config) -> int:
    """Do all steps that the capture allows, as `recon.session.plan.run`; returns 1 if a part could not be used, or none."""
    code, usual = code_digest("recon", "sonotwin", folder()), choices.read_rig().probe
    steps = plan.run(config, config.out, code, usual, command, ConsoleWatch())
    return 1 if steps.failed or not steps.done else 0


def command(settings: optics_step.Settings, out: Path) -> str:
    """The command line that calibrates the optics as a step does."""
    return calibrate_optics.command(calibrate_optics.Config(**dict(settings), out=out))
