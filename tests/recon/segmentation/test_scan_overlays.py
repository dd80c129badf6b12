"""Are the B-scans that are drawn those that show most, all along the sweep?"""

import numpy as np

from recon.segmentation import scan_overlays


def test_of_each_part_of_a_sweep_the_largest_is_drawn():
    sizes = {10: 5, 11: 50, 12: 7, 20: 3, 21: 4, 30: 90, 31: 2, 32: 1}
    assert scan_overlays.spread(sizes, 2) == {11, 30}
    assert scan_overlays.spread(sizes, 100) == set(sizes)
    assert scan_overlays.spread(sizes, 0) == scan_overlays.spread({}, 3) == set()


def test_outlines_are_drawn_around_masks():
    """In the first image of the three there is nothing, and in the second too little."""
    masks = np.zeros((3, 40, 40), bool)
    masks[1, :4, :4] = masks[2, 10:30, 10:30] = True
    (drawn,) = scan_overlays.of_masks(np.full((3, 40, 40), 9, np.uint8), masks, 3)
    assert np.abs(drawn[10, 20] - np.array(scan_overlays.COLOUR)).max() < 60, "smooth lines are mixed with the image"
    assert tuple(drawn[20, 20]) == tuple(drawn[2, 2]) == (9, 9, 9)
