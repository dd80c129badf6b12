"""What is said and counted of masses found in a sweep."""

import numpy as np
import pytest
import trimesh

from recon.segmentation import segmented_scans
from recon.segmentation.containment import Containment
from recon.segmentation.mass_uncertainty import Sigma
from recon.segmentation.masses import Mass


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
