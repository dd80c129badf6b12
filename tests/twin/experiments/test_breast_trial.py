"""Masks of tumours become bodies where they are, and their figures are right, by sections of balls in made-up B-scans."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from twin.experiments import breast_trial

BALLS = {"tumour0": (np.array([4.0, 0.0, 650.0]), 8.0), "tumour1": (np.array([14.0, 3.0, 655.0]), 4.0)}
PROBE = ProbeCalibration(
    rigid.from_rotation_vector(np.array([0.2, 0.1, -0.3]), np.array([5.0, 6.0, 7.0])), np.array([0.12, 0.12])
)
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def body(name: str, radius: float | None = None) -> trimesh.Trimesh:
    centre, true = BALLS[name]
    ball = trimesh.creation.icosphere(4, radius or true)
    return ball.apply_translation(centre)


@pytest.fixture(scope="module")
def sweep():
    """B-scans 0.25 mm apart through both balls, their labels, and the target's poses."""
    labels, matrices = [], []
    v, u = np.mgrid[:300, :300]
    for y in np.arange(-9.0, 9.0, 0.25):
        world_from_image = rigid.transform(UPRIGHT, np.array([-10.0, y, 635.0]))
        places = rigid.apply(world_from_image, np.stack([0.12 * u, 0.12 * v, 0.0 * u], axis=-1).reshape(-1, 3))
        shown = np.zeros(u.size, np.uint8)
        for k, (centre, radius) in enumerate(BALLS.values()):
            shown[np.linalg.norm(places - centre, axis=1) < radius] = k + 2
        labels.append(shown.reshape(u.shape))
        matrices.append(world_from_image @ rigid.invert(PROBE.target_from_image))
    stack = np.stack(matrices)
    return SimpleNamespace(labels=np.stack(labels), solids=("breast", *BALLS), published_at=lambda _: stack)


def test_hulls_of_contours_are_the_bodies(sweep):
    """Contours run through the outermost pixels' middles, half a pixel inside."""
    found = breast_trial.from_masks(SimpleNamespace(latency_s=0.0), sweep, PROBE)
    for mesh, (centre, radius) in zip(found, BALLS.values(), strict=True):
        assert np.linalg.norm(mesh.center_mass - centre) < 0.15
        assert mesh.volume == pytest.approx(4 / 3 * np.pi * (radius - 0.06) ** 3, rel=0.03)


def test_a_body_without_poses_is_none(sweep):
    lost = SimpleNamespace(
        labels=sweep.labels, solids=sweep.solids, published_at=lambda _: np.full((len(sweep.labels), 4, 4), np.nan)
    )
    assert breast_trial.from_masks(SimpleNamespace(latency_s=0.0), lost, PROBE) == []


def test_figures_of_what_was_found():
    """One body is larger by a tenth in radius and off by 0.3 mm, one is missing, one is nowhere."""
    hidden = [SimpleNamespace(name=name, mesh=body(name)) for name in BALLS]
    grown = body("tumour0", 8.8).apply_translation([0.3, 0.0, 0.0])
    elsewhere = trimesh.creation.icosphere(3, 4.0).apply_translation([60.0, 60.0, 650.0])
    grid = np.stack(np.meshgrid(np.arange(-40.0, 41.0), np.arange(-40.0, 41.0)), axis=-1).reshape(-1, 2)
    corners = np.arange(81 * 81).reshape(81, 81)
    a, b, c, d = corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:]
    faces = np.concatenate([np.stack(three, axis=-1).reshape(-1, 3) for three in ((a, b, c), (b, d, c))])
    skin = trimesh.Trimesh(np.column_stack([grid, np.full(len(grid), 630.0)]), faces, process=False)
    figures = breast_trial.figures("ours", [grown, elsewhere], skin, hidden)
    assert (figures["tumours_inside_ours"], figures["tumours_false_ours"]) == (1, 1)
    assert np.isnan(figures["tumour_centre_error_ours_mm"])
    alone = breast_trial.figures("ours", [grown], skin, hidden[:1])
    assert alone["tumour_centre_error_ours_mm"] == pytest.approx(0.3, abs=1e-3)
    assert alone["tumour_volume_error_ours_percent"] == pytest.approx(100 * (1.1**3 - 1), abs=0.1)
