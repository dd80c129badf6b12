"""The probe's target in a frame at once: found and how sharply, or why it isn't, and how to mend that."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from recon.model.rig import Target
from recon.tracking import photographs
from recon.tracking.networks import Networks
from recon.tracking.rims import WHOLE

Judged = tuple[str, tuple[str, ...]]  # figures, and faults with the ways to mend them
Judge = Callable[[NDArray, int], Judged]  # of an image : (h, w) and its bits


Places = Callable[[NDArray, int], NDArray[np.float64]]  # likewise; centres of the circles : (n, 2) px, NaN where not found


def target_places(networks: Networks, target: Target) -> Places:
    """Give what finds the target's circles in camera frames."""

    def places(image: NDArray, bits: int) -> NDArray[np.float64]:
        view = photographs.find(image, networks, target, bits if bits > 8 else None)
        return np.where(view.found & view.outlines.found[:, None], view.outlines.ellipses.centre, np.nan)

    return places


def target_judge(networks: Networks, target: Target) -> Judge:
    """Give a judge of camera frames."""
    most_motion_px = 8.0  # of a circle over an exposure: what the tracker was measured with, and some more

    turn = "turn the target's face to both cameras, within their views, and uncover its circles"

    def judge(image: NDArray, bits: int) -> Judged:
        view = photographs.find(image, networks, target, bits if bits > 8 else None)
        if not view.found:
            return "no target", (f"target not found: {view.reason}; {turn}",)
        moved, seen = float(np.nanmax(view.blur_px)), view.outlines.seen
        text = f"target found, moved by {moved:.1f} px"
        if moved > most_motion_px:
            return text, (f"target blurred by {moved:.0f} px; lead it more slowly, or expose shorter under more light",)
        covered = [f"c{k}" for k in np.flatnonzero(seen < WHOLE)]
        return text, (f"{' and '.join(covered)} partly covered; move hand and cable off the target",) if covered else ()

    return judge
