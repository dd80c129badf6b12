"""Are surfaces of masses clean and as large as before, and distances to them right near and far?"""

import numpy as np
import pytest
import trimesh

from recon.files.volumes import Volume
from recon.freehand.volume_compounding import Grid
from recon.segmentation import mass_surface
from recon.segmentation.mass_surface import Mass

CENTRE, RADIUS = np.array([3.0, 698.0, 14.0]), 5.0


def test_folds_are_evened_out_and_the_volume_stays(rng):
    """Vertices thrown about by 0.15 mm, half of their distance; the ball keeps its place, its volume, and one clean surface."""
    folded = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    folded.vertices += CENTRE + rng.normal(0, 0.15, folded.vertices.shape)
    mass = mass_surface.evened(Mass(folded), np.eye(3))
    assert mass.mesh.is_watertight and mass.mesh.euler_number == 2
    assert mass.volume == pytest.approx(folded.volume, rel=0.002)
    assert np.linalg.norm(mass.centre - CENTRE) < 0.05
    radii = np.linalg.norm(mass.mesh.vertices - mass.centre, axis=1)
    assert radii.std() < 0.075  # half of what they were thrown about


def test_distances_are_known_deep_inside_and_far_away():
    """Half of a mass that reaches deeper than `FAR_MM` would else count as outside."""
    large = trimesh.creation.icosphere(subdivisions=5, radius=12.0)
    large.vertices += CENTRE
    around = Grid((80, 80, 80), CENTRE - 20.0, np.full(3, 0.5), np.eye(3))
    found = mass_surface.distances([Mass(large)], around)
    k, j, i = np.mgrid[:80, :80, :80]
    true = np.linalg.norm(-20 + 0.5 * np.stack([i, j, k], axis=-1), axis=-1) - 12.0
    assert np.abs(found.voxels - np.clip(true, -mass_surface.FAR_MM, mass_surface.FAR_MM)).max() < 0.6  # a voxel's diagonal
    near = np.abs(true) < 0.5
    assert np.abs(found.voxels - true)[near].max() < 0.05


def test_the_largest_of_several_surfaces_is_taken():
    """A ball of 4 mm beside one of 3 mm, dark in bright surroundings: closed, and turned outwards."""
    places = -10 + 0.5 * np.stack(np.mgrid[:41, :41, :81], axis=-1)[..., ::-1]
    balls = [np.linalg.norm(places - middle, axis=-1) - radius for middle, radius in (([0, 0, 0], 3.0), ([15, 0, 0], 4.0))]
    volume = Volume(np.zeros(places.shape[:3], np.float32), np.full(3, -10.0), np.full(3, 0.5))
    mesh = mass_surface.meshed(np.minimum(*balls), 0.0, 3 * (slice(0, None),), volume, outside=5.0)
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi * 4.0**3, rel=0.02)
    np.testing.assert_allclose(mesh.center_mass, [15, 0, 0], atol=0.01)
