"""What stands still: no ray misses it, bodies are closed, posters lie where they say."""

import numpy as np
import pytest

from recon.geometry import rigid
from scenes.handheld.mesh_parts import merged
from scenes.handheld.surroundings import surroundings
from tests.scenes.handheld.closed_parts import check_closed

VARIANTS = 30


@pytest.fixture(scope="module")
def variants():
    return [surroundings(np.random.default_rng([2, k])) for k in range(VARIANTS)]


def test_bodies_are_closed_and_face_outwards(variants):
    for variant in variants:
        check_closed(variant.parts, "poster")


def test_the_bench_lies_below_everything_and_is_wide(variants):
    for variant in variants:
        (bench,) = [part.mesh for part in variant.parts if part.slot == "bench"]
        top = bench.bounds[1, 2]
        assert top >= -810 and top <= 0
        assert (bench.extents[:2] >= 4000).all()
        tables = [part.mesh for part in variant.parts if part.slot == "table"]
        assert (max((mesh.bounds[1, 2] for mesh in tables), default=top)) == pytest.approx(0)


def test_posters_are_where_their_transforms_say(variants):
    seen = 0
    for variant in variants:
        sheets = [part.mesh for part in variant.parts if part.slot == "poster"]
        assert len(sheets) == len(variant.posters)
        for sheet, poster in zip(sheets, variant.posters, strict=True):
            flat = rigid.apply(rigid.invert(poster.scene_from_poster), sheet.vertices)
            assert np.allclose(flat[:, 2], 0, atol=1e-9)
            assert np.allclose(np.abs(flat[:, :2]) * 2, poster.size)
            assert np.allclose(sheet.face_normals, poster.scene_from_poster[:3, 2])
            assert poster.scene_from_poster[2, 2] > 0  # visible from above
            seen += 1
    assert seen >= 10


def test_variants_differ_and_are_small(variants):
    slots = [frozenset(part.slot for part in variant.parts) for variant in variants]
    assert len(set(slots)) > VARIANTS / 3
    for slot in ("phantom", "table", "poster", "skin", "metal", "cable", "thing_a", "thing_b", "thing_c"):
        assert np.mean([slot in found for found in slots]) > 0.1, slot
    for variant in variants:
        assert sum(len(part.mesh.faces) for part in variant.parts) <= 40_000


def test_the_same_seed_gives_the_same_bytes():
    once, twice = (merged(surroundings(np.random.default_rng(8)).parts) for _ in range(2))
    for name in ("vertices", "normals", "faces", "slot"):
        assert getattr(once, name).tobytes() == getattr(twice, name).tobytes()
