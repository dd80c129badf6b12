"""B-scans that an export writes, with the frames nearest to each where these go along."""

from pathlib import Path

import numpy as np

from recon.capture import manifest, paired_scans, stereo_frames, sweep_part
from recon.capture.manifest import CAMERAS, MANIFEST, Purpose
from recon.capture.paired_scans import PairedScans
from sonotwin.export_layouts import Settings


def read(settings: Settings, capture: Path, purpose: Purpose) -> tuple[PairedScans, list[str]]:
    """Read the B-scans of a sweep that have a pose; returns them and lines about them, the first without a heading.

    Raises
    ------
    InputError
        If there is no such sweep, it is damaged, no B-scan has a pose, or none has frames that are near enough.
    """
    sweep = sweep_part.read_sweep(capture, settings.sweep, purpose, settings.implausible)
    place, part = manifest.read_manifest(capture).sweep_of(capture / MANIFEST, "a sweep", settings.sweep, purpose)
    if not settings.frames or not set(CAMERAS) <= part.images.keys():
        selected = paired_scans.alone(sweep, settings.lag_s)
        return selected, [f"{len(selected.scans)} of {len(sweep.paths)} B-scans, those with a pose"]
    film = stereo_frames.read_film(capture, settings.calibration, place.partition("/")[2])
    paired = paired_scans.pair(sweep, film, settings.lag_s, settings.apart_s)
    apart, moved = 1e3 * np.abs(paired.apart_s), paired.moved_mm
    return paired, [
        f"{len(paired.scans)} of {len(sweep.paths)} B-scans, those with a pose, and the frames nearest to each",
        f"pose        that of the frames, {np.median(apart):.3g} ms from their B-scans (median; {apart.max():.3g} at most), in "
        f"which the target moved by {np.median(moved):.2g} mm ({moved.max():.2g} at most); frames=false gives the B-scans' own",
    ]
