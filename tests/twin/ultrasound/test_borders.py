"""Spans of depth that may hold borders: none outside of them."""

import numpy as np
import pytest

from recon.geometry import rigid
from scenes.catalogue import build_scene
from tests.twin.ultrasound.phantoms import down
from twin.ultrasound import borders
from twin.ultrasound.echo_solids import body, distance_at, label_at
from twin.ultrasound.scan_lines import lines_of


@pytest.fixture(scope="module")
def made():
    return body(build_scene({"kind": "test_object"}))


@pytest.mark.parametrize("turn", [(0, 0, 0), (0.3, 0.2, -0.1)])
def test_no_border_lies_outside_the_spans(made, small, rng, turn):
    """Rays at random, looked at every 0.05 mm: where the tissue changes, their bundle has a span; most of the way has none."""
    pose = down(small, (4.0, -2.0, 655.0)) @ rigid.from_rotation_vector(turn, [0, 0, 0])
    x, z = np.arange(-2, 14, 0.0615), 0.2 * np.arange(-15, 16)
    spans, counts, sides = borders.spans(made, lines_of(small), pose, x, z, np.zeros(len(z)), 50.0)
    packed, depths, met = made.packed(), np.arange(0, 50, 0.05), 0
    apart = 0
    for _ in range(60):
        i, k = int(rng.integers(len(x))), int(rng.integers(len(z)))
        bundle = i // borders.BUNDLE[0], k // borders.BUNDLE[1]
        places = rigid.apply(pose, np.column_stack([np.full(len(depths), x[i]), depths, np.full(len(depths), z[k])]))
        labels = np.array([label_at(packed, *place) for place in places])
        for n in np.flatnonzero(np.diff(labels)):
            found = spans[bundle][: counts[bundle]]
            about = (found[:, 0] <= depths[n + 1]) & (found[:, 1] >= depths[n])
            assert about.any()
            assert (sides[bundle][: counts[bundle]][about, max(labels[n], labels[n + 1]) - 1] == borders.NEAR).any()
            met += 1
        for span, side in zip(spans[bundle][: counts[bundle]], sides[bundle][: counts[bundle]], strict=True):
            inner = places[(depths >= span[borders.START]) & (depths <= span[borders.STOP])]
            for solid in np.flatnonzero(side != borders.NEAR):
                distances = np.array([distance_at(packed, solid, *place) for place in inner])
                assert (distances * side[solid] > 0).all()
                apart += 1
    assert met > 20 and apart > 20
    assert (spans[..., 1] - spans[..., 0]).sum() < 0.5 * 50 * counts.size
