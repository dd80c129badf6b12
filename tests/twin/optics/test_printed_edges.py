"""Computed edges of a board's discs: against path tracing with very many samples."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from recon.model.patterns import Patterns
from scenes import board_poses
from scenes.kinds import board
from tests.twin.small_rigs import cropped
from twin import board_session
from twin.optics.light_transport import Tracing, render_pixels
from twin.optics.printed_edges import compute_edges
from twin.optics.surface_session import Shooting

PIXELS = 400  # looked at
PATHS = 1024  # a pixel of the reference
BORDER = 16  # px, half of the window in which a pixel's neighbours are looked for, and the reach of its light


@pytest.fixture(scope="module")
def patterns() -> Patterns:
    """Any; the board is lit evenly."""
    with open("conf/patterns/paper_surface.yaml", encoding="utf-8") as file:
        return Patterns.model_validate(yaml.safe_load(file))


@pytest.mark.parametrize(
    ("design", "aperture"),
    [
        (board.Config(), 1.0),
        (board.Config(warp_mm=1.0, bow_mm=(0.5, 1.0, -0.5), print_error_mm=0.1, spread_mm=0.1), 3.0),
        (board.Config(roughness=0.3), 0.0),
    ],
)
def test_edges_are_those_of_very_many_paths(rig, patterns, design, aperture, rng):
    """In focus, bowed and out of focus, and glossy with a pinhole: no bias, and less noise than 256 paths leave.

    In the middle of the image, where some ten discs lie.
    """
    narrow = rig.model_copy(update={"cam1": cropped(rig.cam1, (400, 320))})
    settings = board_session.Settings(
        narrow, design, board_poses.Config(count=2), patterns, ("cam1",), Tracing(samples=8), Shooting(), seed=1
    )
    stage = board_session.set_up(settings)
    optics = stage.cameras["cam1"]
    optics = replace(optics, aperture_mm=aperture * optics.aperture_mm)
    pose = board_session.place_all(replace(settings, rig=rig))[1]
    board_session.move_things(stage.world, stage.things, pose)
    light = board_session.fully_on(stage.patterns)
    traced = board_session.trace_near(stage, optics, light, settings.tracing, 1)[0]
    computed = traced.copy()
    left = compute_edges(computed, optics, stage.print, pose, 1)
    changed = np.flatnonzero(computed != traced)
    v, u = np.unravel_index(left.edges, traced.shape)  # at the image's border discs aren't seen with all that is about them
    inner = (np.minimum(u, v) > BORDER) & (u < traced.shape[1] - BORDER) & (v < traced.shape[0] - BORDER)
    assert inner.sum() < 0.001 * len(changed) and not np.isin(left.sides, changed).any()
    chosen = rng.choice(changed, PIXELS, replace=False).astype(np.uint32)
    many = Tracing(samples=PATHS)
    truth = render_pixels(stage.world, optics, stage.projector, light, many, 7, chosen, convex=stage.convex)[0]
    white = np.percentile(traced, 99)
    error = (computed.ravel()[chosen] - truth) / white
    assert abs(error.mean()) < 6e-4  # the mean scatters by 2e-4
    assert error.std() < 6e-3
