"""Is it counted right in which poses a device found the board?"""

import numpy as np

from recon.optical_calibration.board_frames import found_by
from recon.optical_calibration.sightings import Sighting

SIZE = (320, 256)


def test_a_device_counts_where_it_sees_points():
    nowhere, somewhere = np.full((4, 2), np.nan), np.arange(8.0).reshape(4, 2)
    sightings = [Sighting(name, {"cam1": somewhere, "cam2": at}, {}, nowhere) for name, at in (("a", nowhere), ("b", somewhere))]
    assert found_by(sightings, {"cam1": SIZE, "cam2": SIZE}) == "2 poses: cam1 2, cam2 1"
