"""Is every frame without the crossing counted with its reason?"""

import numpy as np
import pytest

from recon.errors import InputError
from recon.probe_calibration import phantom_frames
from recon.probe_calibration.cross_wire import Crossing
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.point_calibration import Sightings

NOWHERE = (np.full(2, np.nan), np.full((2, 2), np.nan), np.nan)


def test_reasons_are_put_together_by_kind():
    reasons = ["blurred: 9x3 px", None, "no echo stands out", "blurred: 8x4 px"]
    crossings = tuple(Crossing(*NOWHERE, reason) for reason in reasons)
    frames = PhantomFrames(
        "wires",
        (321, 408),
        Sightings(np.eye(4)[None], np.ones((1, 2))),
        np.array([2, 3, 5, 8]),
        crossings,
        poses=np.tile(np.eye(4), (4, 1, 1)),
    )
    assert frames.usable.tolist() == [1]
    assert phantom_frames.rejected(frames) == {"blurred": [2, 8], "no echo stands out": [5]}
    with pytest.raises(
        InputError,
        match=r"wires: expected 6 frames or more .* found 1 \(most often: blurred: 9x3 px; .*give appearance.max_sigma_px\)",
    ):
        phantom_frames.refuse_few(frames)


def test_n_wires_are_named_with_the_way_past():
    """Three bright spots a row, as PLUS's phantoms show them: no setting of the appearance makes one crossing of these."""
    image, (v, u) = np.full((200, 240), 12.0), np.mgrid[:200, :240]
    for row in (70, 120):
        for column in (60, 110, 190):
            image += 200 * np.exp(-(((u - column) / 5) ** 2 + ((v - row) / 2.5) ** 2) / 2)
    images = [np.clip(image, 0, 255).astype(np.uint8)] * 8
    frames = phantom_frames.look("nwires", images, (240, 200), np.arange(8), np.tile(np.eye(4), (8, 1, 1)))
    with pytest.raises(InputError, match=r"several candidates: . spots.* phantom=n_wires .* pairs=FILE.*rival_db\)$") as said:
        phantom_frames.refuse_few(frames)
    assert "another scanner" not in str(said.value)


def test_pairs_are_frames_that_are_all_usable():
    frames = phantom_frames.of_pairs("pairs.csv", (321, 408), np.tile(np.eye(4), (7, 1, 1)), np.arange(14.0).reshape(7, 2))
    assert frames.usable.tolist() == frames.numbers.tolist() == list(range(7))
    phantom_frames.refuse_few(frames)
