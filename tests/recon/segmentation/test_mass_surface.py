"""Are surfaces of masses clean and as large as before, and distances to them right near and far?"""

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from recon.files.volumes import Volume
from recon.freehand.volume_compounding import Grid
from recon.segmentation import mass_surface
from recon.segmentation.mass_surface import Mass
from scenes.mass_forms import mass

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


@pytest.mark.parametrize("form", ["round", "oval", "lobulated", "irregular", "spiculated"])
@pytest.mark.parametrize("size_mm", [10.0, 25.0])
def test_a_mass_of_one_form_is_one(form, size_mm, rng):
    """However many lobes and spikes it has."""
    for _ in range(3):
        one = Mass(mass(form, size_mm, rng))
        assert mass_surface.parted(one, np.eye(3)) == [one]


@pytest.mark.parametrize("sizes_mm", [(12.0, 12.0), (14.0, 10.0)])
def test_two_masses_that_touch_are_parted_at_their_waist(sizes_mm, rng):
    """Their borders run into each other over 0.5 mm, as the blur of B-scans has it."""
    one, other = (mass("lobulated", size, rng) for size in sizes_mm)
    other.apply_translation([one.vertices[:, 0].max() - other.vertices[:, 0].min() - 1.0, 0.0, 0.0])
    step = 0.4
    grid = mass_surface.grid_over(np.vstack([one.vertices, other.vertices]), np.eye(3), np.full(3, step), 3.0)
    near = np.minimum(*(mass_surface.distances([Mass(body)], grid).voxels for body in (one, other)))
    joined = Volume(ndimage.gaussian_filter(near, 0.5 / step), grid.origin, grid.spacing, grid.directions)
    whole = Mass(mass_surface.meshed(joined.voxels, 0.0, 3 * (slice(0, None),), joined, outside=5.0))
    parts = mass_surface.parted(whole, np.eye(3))
    assert len(parts) == 2 and all(part.beside and part.mesh.is_watertight for part in parts)
    for part, true in zip(parts, sorted((one, other), key=lambda body: -body.volume), strict=True):
        assert part.volume == pytest.approx(true.volume, rel=0.12)
        assert np.linalg.norm(part.centre - true.center_mass) < 0.5
