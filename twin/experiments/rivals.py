"""Rivals of the tracker over light and blur: detection rate and accuracy of each."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from recon.files import atomic
from recon.model.rig import Target
from recon.reports.figures import SEQUENTIAL
from recon.tracking import networks as nets
from recon.tracking.networks import Networks
from recon.tracking.pose import estimate
from recon.tracking.pose_fit import Sighting
from recon.tracking.tracker import Tracker
from twin.experiments import tracking_frames
from twin.experiments.baselines import classical, fiducials
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.pose_accuracy import Images, Locate, Pair, cameras_of, pose_errors
from twin.experiments.tracking_frames import exactly_printed
from twin.tracking.surface_prints import BitGrid

Array = NDArray[np.float64]

SEED = 2003
WHITES, BLURS, COUNT = (6.0, 12.0, 25.0, 60.0, 150.0), (0.0, 4.0, 8.0, 12.0, 20.0), 2  # DN, px, frames a cell
RAYS = 8  # a pixel
ELSEWHERE_MM = 5.0  # an error beyond that is another thing than the target
DARK_DN, BLURRED_PX, LIT_DN = 12.0, 12.0, 60.0
FIGURE = "rivals.png"


@dataclass(frozen=True)
class Choice:
    """A way to find a target's pose, and the target that it needs."""

    name: str
    locate: Locate
    face: BitGrid | None = None  # instead of the circles


@dataclass(frozen=True)
class Tried:
    """One choice over the grid of light and blur."""

    name: str
    shift_mm: Array  # (whites, blurs, frames), NaN where it wasn't found
    turn_deg: Array

    @property
    def found(self) -> Array:
        """Share of frames : (whites, blurs) in %."""
        return 100 * np.isfinite(self.shift_mm).mean(axis=2)


def choices(target: Target, networks: Networks) -> list[Choice]:
    """Ours and its rivals; those that need the same face side by side."""
    aruco, april = fiducials.aruco_board(target), fiducials.apriltag_board(target)
    return [
        Choice("ours", ours(target, networks)),
        Choice("classical", classic(target)),
        Choice("ArUco board", marked(aruco), bits(aruco)),
        Choice("AprilTag board", marked(april), bits(april)),
    ]


def grid(setup: Setup) -> Figures:
    """Summaries of the grid; a figure of all its cells in `setup.out`."""
    setup = exactly_printed(setup)
    alike = groupby(choices(setup.rig.target, nets.load(kind=setup.rig.target.kind)), key=lambda choice: id(choice.face))
    tried = [one for _, some in alike for one in over_grid(setup, list(some))]
    if setup.out is not None:
        draw(tried, setup.out / FIGURE)
    return {f"{one.name}: {name}": value for one in tried for name, value in summary(one).items()}


def over_grid(setup: Setup, alike: Sequence[Choice]) -> list[Tried]:
    """Try choices that need the same face on the same frames, in all cells."""
    errors = np.full((len(alike), len(WHITES), len(BLURS), COUNT, 2), np.nan)
    for i, j in np.ndindex(len(WHITES), len(BLURS)):
        for k, (take, given) in enumerate(tracking_frames.study(setup, SEED, COUNT, WHITES[i], BLURS[j], RAYS, alike[0].face)):
            for n, choice in enumerate(alike):
                error = pose_errors(take, choice.locate(cameras_of(take), given.views))
                if error is not None and error[0] < ELSEWHERE_MM:
                    errors[n, i, j, k] = error
    return [Tried(choice.name, one[..., 0], one[..., 1]) for choice, one in zip(alike, errors, strict=True)]


def summary(tried: Tried) -> Figures:
    """Detection rates, everywhere, in the dark and when blurred; errors at rest in good light, if there are any."""
    dark, blurred, lit = np.array(WHITES) <= DARK_DN, np.array(BLURS) >= BLURRED_PX, np.array(WHITES) >= LIT_DN
    found, exact = tried.found, {"shift_mm": tried.shift_mm[lit, 0], "turn_deg": tried.turn_deg[lit, 0]}
    shares = {"found": found.mean(), "found_dark": found[dark].mean(), "found_blurred": found[:, blurred].mean()}
    return shares | {name: np.nanmedian(values) for name, values in exact.items() if np.isfinite(values).any()}


def draw(tried: Sequence[Tried], path: Path) -> None:
    """Write a figure of all cells: shares found, and medians of the errors in mm within."""
    figure = Figure(figsize=(3.2 * len(tried), 3.4), layout="constrained")
    for one, axes in zip(tried, figure.subplots(1, len(tried), sharey=True), strict=True):
        shown = axes.imshow(one.found, vmin=0, vmax=100, cmap=SEQUENTIAL, aspect="auto")
        for i, j in np.ndindex(one.found.shape):
            known = one.shift_mm[i, j][np.isfinite(one.shift_mm[i, j])]
            text = f"{np.median(known):.2g}" if len(known) else "-"
            axes.text(j, i, text, ha="center", va="center", fontsize=8, color="black" if one.found[i, j] > 60 else "white")
        axes.set(title=one.name, xlabel="blur, px", xticks=range(len(BLURS)), yticks=range(len(WHITES)))
        axes.set_xticklabels([f"{blur:g}" for blur in BLURS])
        axes.set_yticklabels([f"{white:g}" for white in WHITES])
    figure.axes[0].set_ylabel("target's white, of 255")
    figure.colorbar(shown, ax=figure.axes, label="poses found, %")
    with atomic.new_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def ours(target: Target, networks: Networks) -> Locate:
    """The tracker, knowing nothing before."""

    def locate(cameras: Pair, images: Images) -> Array | None:
        result = Tracker(cameras, target, networks, drift_px=0, board_scale=0).step(*images)
        return result.pose.world_from_target if result.found else None

    return locate


def classic(target: Target) -> Locate:
    """Threshold, contours, ellipses and geometry in each view, then our pose."""

    def locate(cameras: Pair, images: Images) -> Array | None:
        seen = [classical.find(image, target) for image in images]
        if not all(view.found for view in seen):
            return None
        first, second = (Sighting(camera, view.centres, view.covariance) for camera, view in zip(cameras, seen, strict=True))
        result = estimate(first, second, target)
        return result.world_from_target if result.found else None

    return locate


def marked(board: fiducials.Board) -> Locate:
    """A board of markers in the target's place."""

    def locate(cameras: Pair, images: Images) -> Array | None:
        first, second = (fiducials.sight(image, camera, board) for image, camera in zip(images, cameras, strict=True))
        result = fiducials.estimate(first, second, board)
        return result.world_from_target if result.found else None

    return locate


def bits(board: fiducials.Board) -> BitGrid:
    """A marker board's face, for the twin to print."""
    x, y = (float(value) for value in board.origin_mm)
    return BitGrid(board.cells, (x, y), (board.cell_mm, board.cell_mm))
