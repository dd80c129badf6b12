"""Calibrate the ultrasound probe: where the pixels of its B-scans lie in the frame of the target that it carries.

Reads the sweep part of a capture folder, or a tracked sequence of the PLUS toolkit: B-scans of the crossing of two wires at
rest in water, seen from many sides, of N-wires, of a flat wall or a sphere, or of a tracked stylus' tip; or pairs of a pose and
the crossing's pixel, found elsewhere. Writes into the folder `out`: probe.yaml (with its covariance); the same in the rig
authors' layout, US_params.npz; frames.csv, the outcome of each frame; and metrics.json. A calibration that is there already is
replaced. Takes a second for thirty B-scans.

Give several runs, in one capture or many, for their repeatability: CR1 and CR2 of Meza et al. 2021 beside those that the
covariances predict, whether the runs scatter more than that (chi-square), and each run's crossing by the others' calibration
(held out). probe.yaml is then their mean, with a covariance that has the scatter in it, and runs.csv has a row a run.

Let the probe rest at each frame, or give the lag; or keep moving, and lag_s=free finds it as well, and writes it to lag.json.
Tilt the probe by 35 degrees, mostly forward and backward, roll it as far as the target is seen, and bring the crossing near all
corners of the image in turn. N-wires stay in view whole: by PLUS's configuration with the phantom's registration little motion
will do, without it turn the probe about two axes. A stylus is tracked as a further body, and its tip led to all corners of the
image; where tip.yaml has that, nothing needs to be turned. Over a rough wall take 100 poses: tilt the probe to 40 degrees
forward and backward, rock it to 25, roll it and change the distance. About a sphere do the same, with its top beside the
image's plane as often as in it.

    sonotwin calibrate-probe capture=outputs/wires/capture out=outputs/probe
    sonotwin calibrate-probe capture=outputs/wires/capture temperature_c=22.4 out=outputs/probe
    sonotwin calibrate-probe capture=outputs/wires/capture earlier=outputs/probe/probe.yaml out=outputs/probe_again
    sonotwin calibrate-probe sequence=wires.igs.mha reference=Tracker clip=[120,80,400,500] out=outputs/probe
    sonotwin calibrate-probe phantom=n_wires wires=fcal.xml sequence=rows.igs.mha temperature_c=22 out=outputs/probe
    sonotwin calibrate-probe phantom=wall capture=outputs/wall/capture temperature_c=22 out=outputs/probe
    sonotwin calibrate-probe phantom=sphere sphere_radius_mm=19.8 capture=outputs/ball/capture temperature_c=22 out=outputs/probe
    sonotwin calibrate-probe phantom=stylus body=needle tip=outputs/tip/tip.yaml capture=outputs/stylus/track out=outputs/probe
    sonotwin calibrate-probe phantom=stylus sequence=stylus.igs.mha reference=Stylus tip=outputs/tip/tip.yaml out=outputs/probe
    sonotwin calibrate-probe capture=outputs/wires/capture lag_s=free out=outputs/probe
    sonotwin calibrate-probe pairs=pairs.csv out=outputs/probe
    sonotwin calibrate-probe runs=[outputs/session/capture] temperature_c=22.4 out=outputs/probe
    sonotwin calibrate-probe runs=[outputs/monday/probe.yaml,outputs/friday/probe.yaml] out=outputs/probe
    sonotwin calibrate-probe pairs=pairs.csv rig.probe.image_size=[640,480] temperature_c=22.4 out=outputs/probe
"""

from pathlib import Path

from recon.session import probe_runs_step, probe_step
from sonotwin import choices
from sonotwin.console_watch import ConsoleWatch


class Config(probe_step.Settings):
    """Fields of `sonotwin calibrate-probe`: sources, target, and all that is known beforehand."""

    out: Path
    """folder; gets probe.yaml, US_params.npz, frames.csv, metrics.json, lag.json of lag_s=free, and of several runs runs.csv"""


def run(config: Config) -> None:
    """Find the phantom in all frames, calibrate, judge and write; raises InputError as `recon.session.probe_step.run`."""
    step = probe_runs_step if config.runs else probe_step
    step.run(config, config.out, choices.read_rig().probe, ConsoleWatch())
