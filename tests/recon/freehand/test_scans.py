"""B-scans in space: are they read no more often than need be, and no more kept than there is room for?"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from recon.freehand import scans
from recon.freehand.scans import Scans


def recorded(reads: list[int]) -> Scans:
    def stream():
        for k in range(3):
            reads.append(k)
            yield np.full((4, 5), k, np.uint8)

    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[1] = np.nan
    return Scans((4, 5), matrices, stream, 1540.0, 1488.0)


def test_images_are_read_once_where_there_is_room():
    reads = []
    kept = scans.in_memory(recorded(reads), 60)
    for _ in range(3):
        np.testing.assert_array_equal([image[0, 0] for image in kept.stream()], [0, 1, 2])
    assert reads == [0, 1, 2]


def test_images_are_read_anew_where_there_is_none():
    reads = []
    streamed = scans.in_memory(recorded(reads), 59)
    assert not reads
    assert [image[0, 0] for image in streamed.stream()] == [image[0, 0] for image in streamed.stream()]
    assert reads == 2 * [0, 1, 2]


def test_what_is_said_of_them():
    few = recorded([])
    assert scans.summary(few) == "3 B-scans, 5x4, 2 with a pose"
    assert scans.depths(few) == "right for sound of 1540 m/s, converted from 1488 m/s, for which the probe is calibrated"


def test_the_speed_of_sound_of_bone_is_doubted():
    few = recorded([])
    said = ["".join(scans.cautions(replace(few, speed_m_s=speed))) for speed in (1000.0, 1540.0, 3500.0)]
    assert ["of bone or gas?" in each for each in said] == [False, False, True]


def test_what_is_assumed_is_said_and_counts():
    """A lag that isn't given is 0 to 0.2 s, a tissue's speed of sound any; known ones count as told."""
    fields = scans.ScansFields(capture=Path("c"))
    assert fields.unsure == (0.1, 50.0) and fields.lag == 0
    said = list(fields.assumptions(1540.0))
    assert said[0].startswith("no lag of the B-scans, ± 100 ms") and said[1].startswith("sound of 1540 m/s in what was scanned")
    assert next(fields.assumptions(1540.0, poses_exact=True)).startswith("poses without errors, as they have no covariance")
    known = scans.ScansFields(capture=Path("c"), lag_s=0.05, tissue_m_s=1450.0)
    assert known.unsure == (0.0, 25.0) and not list(known.assumptions(1450.0))
    assert scans.ScansFields(capture=Path("c"), lag_sigma_s=0.02, tissue_sigma_m_s=3.0).unsure == (0.02, 3.0)
    assert scans.ScansFields(sequence=Path("s")).unsure.lag_s == 0, "its poses are those of the images' own time"
