"""What is said and counted of masses found in a sweep."""

import numpy as np
import pytest
import trimesh

from recon.geometry.primitives import Cylinder
from recon.segmentation import segmented_scans
from recon.segmentation.containment import Containment
from recon.segmentation.mass_uncertainty import Sigma
from recon.segmentation.masses import Mass
from recon.segmentation.segmented_scans import Segmented
from recon.segmentation.tube_cover import Cover


def test_whether_a_mass_is_inside_may_be_unknown():
    """Covered by less than half, with nothing above the surface."""
    mass = Mass(trimesh.creation.icosphere(radius=3))
    depths = np.full(len(mass.mesh.vertices), np.nan)
    depths[: round(0.48 * len(depths))] = 2.0
    under = Containment(depths, np.tile([0.0, 0.0, -1.0], (len(depths), 1)), np.zeros(len(depths)))
    assert segmented_scans.describe(mass, Sigma(0.5, 10.0), under).endswith("unknown: only 48 % lies under the surface")
    figures = segmented_scans.measure("mass0", mass, Sigma(0.5, 10.0, 0.3), under)
    assert figures["mass0_depth_sigma_mm"] == 0.3
    assert figures["mass0_volume_sigma_mm3"] == 10.0 and figures["mass0_centre_sigma_mm"] == 0.5
    assert np.isnan(figures["mass0_inside"]) and figures["mass0_covered"] == pytest.approx(0.48, abs=0.01)


def test_a_volume_that_is_hardly_known_has_a_warning():
    """Where its uncertainty isn't known, none is doubted."""
    mass = Mass(trimesh.creation.icosphere(3, 3.0))
    for share, warned in ((0.065, True), (0.055, False), (np.nan, False)):
        lines = segmented_scans.doubts("mass2", mass, Sigma(0.1, share * mass.volume))
        assert lines == (["warning     volume: mass2's is known to 13 % only (2 sigma)"] if warned else [])


def test_a_skin_of_unknown_uncertainty_is_named_beside_the_depth():
    """A depth below it has no standard deviation, where one below a skin of none beside the border's has."""
    mass = Mass(trimesh.creation.icosphere(radius=3))
    count = len(mass.mesh.vertices)
    depths, normals = np.full(count, 2.0), np.tile([0.0, 0.0, -1.0], (count, 1))
    known, unknown = (Containment(depths, normals, np.full(count, sigma)) for sigma in (0.0, np.nan))
    assert segmented_scans.describe(mass, Sigma(0.5, 10.0, 0.3), known).endswith("inside, 2.00 ± 0.30 mm below the skin")
    said = segmented_scans.describe(mass, Sigma(0.5, 10.0), unknown)
    assert "2.00 mm below the skin, which has no sigma_mm there" in said


def test_a_cover_stands_beside_its_tube():
    """Both over the same length, with the wall in figures and on the console."""
    axis, ends = np.array([1.0, 0, 0]), np.array([[-20.0, 0, 600], [20, 0, 600]])
    tube = Cylinder("", np.array([0.0, 0, 600]), axis, 8.0)
    inner = Segmented({"tube": segmented_scans.between(tube, ends)}, {"tube_diameter_mm": 16.0}, ["tube"], [])
    cover = Cover(Cylinder("", np.array([5.0, 0, 601]), axis, 30.0), 0.02, 21.0)
    found = segmented_scans.covered(inner, cover, ends, 0.05)
    measured = {"cover_diameter_mm": 60.0, "cover_rms_mm": 0.02, "cover_wall_mm": 21.0, "cover_wall_sigma_mm": 0.05}
    assert found.figures == {"tube_diameter_mm": 16.0} | measured
    assert np.allclose(found.meshes["cover"].bounds[:, 0], [-20, 20]) and "wall 21.000 mm ± 0.050" in found.lines[-1]
    unknown = segmented_scans.covered(inner, cover, ends, np.nan)
    assert unknown.lines[-1].endswith("wall 21.000 mm")
    assert np.allclose(found.meshes["cover"].bounds[:, 2], [571, 631], atol=0.05)
