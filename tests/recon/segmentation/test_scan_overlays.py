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


def test_slits_and_spikes_are_not_drawn():
    """Two pixels wide, and ten long; a mask at the image's end keeps its border there."""
    mask = np.zeros((60, 60), bool)
    mask[20:, 20:40] = True
    mask[20:30, 29:31], mask[50:52, 8:20] = False, True
    (drawn,) = scan_overlays.of_masks(np.full((1, 60, 60), 9, np.uint8), mask[None], 1)
    lit = (drawn != 9).any(axis=-1)
    assert not lit[23:40, 25:35].any() and not lit[:, :17].any()
    assert lit[20, 25:28].all() and lit[30:45, 20].all() and lit[59, 25:35].all()
