"""The target found without learning: where it is, with the right names, and nowhere else."""

import cv2
import numpy as np
import pytest

from recon.geometry import rigid
from recon.geometry.circle_projection import centre_offsets
from recon.model import circle_layout
from tests.recon.tracking import flat_faces
from twin.experiments.baselines import classical
from twin.optics.surface_session import calibration_of


@pytest.fixture(scope="module")
def camera(rig):
    return calibration_of(rig).cameras["cam1"]


def shown(camera, target, world_from_target):
    """Centres : (3, 2) px of the outlines' ellipses."""
    model = circle_layout.circle_centres(target)
    offsets = centre_offsets(camera, world_from_target, model, target.outer_diameter_mm / 2)
    return camera.project(rigid.apply(world_from_target, model)) + offsets


@pytest.mark.parametrize("tilt", [(0, 0), (50, 0), (-50, 0), (0, 50), (0, -50), (35, 35)])
def test_centres_and_names_over_the_whole_tilt(camera, rig, rng, tilt):
    for turn in (20, 200):
        place = rng.uniform([-50, -50, 600], [50, 50, 710])
        true = flat_faces.facing(tilt, turn, place)
        image = flat_faces.view(camera, true, flat_faces.circles(rig.target), rig.target, rng=rng)
        found = classical.find(image, rig.target)
        assert found.found, found.reason
        assert np.abs(found.centres - shown(camera, rig.target, true)).max() < 0.1


def test_the_covariance_is_that_of_the_errors(camera, rig, rng):
    """Squared normalised errors of 24 centres have a mean of 2, within 4 standard errors, where images are sharp."""
    squared = []
    for _ in range(8):
        true = flat_faces.facing(rng.uniform(-30, 30, 2), rng.uniform(-180, 180))
        image = flat_faces.view(camera, true, flat_faces.circles(rig.target), rig.target, noise=3.0, rng=rng)
        found = classical.find(image, rig.target)
        off = found.centres - shown(camera, rig.target, true)
        squared += list(np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance), off))
    assert abs(np.mean(squared) - 2) < 4 * 2 / np.sqrt(len(squared))


@pytest.mark.parametrize("look", [{"dark": 6, "white": 30, "ground": 10}, {"blur": 4.0, "noise": 3.0}, {"ground": 20}])
def test_dim_and_blurred_targets_are_found(camera, rig, rng, look):
    true = flat_faces.facing((20, -25), 70)
    image = flat_faces.view(camera, true, flat_faces.circles(rig.target), rig.target, rng=rng, **look)
    found = classical.find(image, rig.target)
    assert found.found, found.reason
    assert np.abs(found.centres - shown(camera, rig.target, true)).max() < 0.3


def test_found_among_clutter(camera, rig, rng):
    for _ in range(2):
        true = flat_faces.facing(rng.uniform(-35, 35, 2), rng.uniform(-180, 180))
        ground = flat_faces.clutter(camera.size[::-1], rng)
        image = flat_faces.view(camera, true, flat_faces.circles(rig.target), rig.target, ground=ground, rng=rng)
        found = classical.find(image, rig.target)
        assert found.found, found.reason
        assert np.abs(found.centres - shown(camera, rig.target, true)).max() < 0.1


def test_a_mirrored_target_is_not_the_target(camera, rig, rng):
    true = flat_faces.facing((10, 15), 40)
    image = flat_faces.view(camera, true, flat_faces.circles(rig.target), rig.target, rng=rng)
    assert not classical.find(np.ascontiguousarray(image[:, ::-1]), rig.target).found


def test_a_hidden_circle_is_missed_with_a_reason(camera, rig, rng):
    true = flat_faces.facing((10, 15), 40)
    image = flat_faces.view(camera, true, flat_faces.circles(rig.target), rig.target, rng=rng)
    u, v = (int(x) for x in shown(camera, rig.target, true)[2])
    cv2.circle(image, (u + 30, v), 50, 120, -1)
    found = classical.find(image, rig.target)
    assert "fewer than three" in found.reason and np.isnan(found.centres).all()


@pytest.mark.parametrize("kind", ["noise", "blank", "faint noise", "clutter"])
def test_nothing_where_there_is_no_target(camera, rig, rng, kind):
    shape = camera.size[::-1]
    for _ in range(2):
        images = {
            "noise": rng.integers(0, 256, shape).astype(np.uint8),
            "blank": np.full(shape, 90, np.uint8),
            "faint noise": np.clip(np.rint(40 + 2 * rng.standard_normal(shape)), 0, 255).astype(np.uint8),
            "clutter": flat_faces.clutter(shape, rng),
        }
        found = classical.find(images[kind], rig.target)
        assert not found.found and found.reason


def test_the_rig_s_photograph(rig, real):
    """Names and centres in the public photograph, scaled back up: positions read off by eye, to a pixel of the small one."""
    small = cv2.imread(str(real / "tracking_photo" / "cam2.png"), cv2.IMREAD_GRAYSCALE)
    found = classical.find(cv2.resize(small, (1280, 1024), interpolation=cv2.INTER_LINEAR), rig.target)
    assert found.found, found.reason
    by_eye = (np.array([[35, 137], [32, 164], [75, 138]]) + 0.5) * [1280 / 300, 1024 / 240] - 0.5
    assert np.abs(found.centres - by_eye).max() < 1280 / 300
