"""What the probe carries: a print that stays whole, closed bodies, and now and then something before a circle."""

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.geometry import rigid
from scenes.handheld.handheld_assembly import Ranges, as_designed, held
from scenes.handheld.mesh_parts import merged
from tests.scenes.handheld.closed_parts import check_closed

VARIANTS = 14
DIRECTIONS = np.deg2rad(np.arange(0, 360, 5))


@pytest.fixture(scope="module")
def variants(rig):
    return [held(np.random.default_rng([5, k]), rig.target) for k in range(VARIANTS)]


def discs(target):
    return np.array([[0, 0], [target.c1_mm, 0], [0, target.c2_mm]])


def test_the_target_is_one_rectangle_in_its_plane_with_white_around_each_disc(variants, rig):
    radius = rig.target.outer_diameter_mm / 2 + 3
    rims = discs(rig.target)[:, None] + radius * np.stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)], axis=-1)
    for parts in variants:
        (front,) = [part.mesh for part in parts if part.slot == "target"]
        assert len(front.faces) == 2 and (front.vertices[:, 2] == 0).all()
        assert np.allclose(front.face_normals, [0, 0, 1])
        low, high = front.bounds[:, :2]
        assert front.area == pytest.approx(np.prod(high - low))
        assert (rims >= low - 1e-9).all() and (rims <= high + 1e-9).all()
        assert np.all(np.abs((high - low) / rig.target.board_mm - 1) <= 0.08 + 1e-9)


def test_the_board_s_place_varies(variants, rig):
    """The circles are not in the board's middle by rule: a network that relies on it would fail on a real board."""
    middles = np.array([parts[0].mesh.bounds[:, :2].mean(axis=0) for parts in variants])
    assert (np.ptp(middles, axis=0) > [4, 0.5]).all()


def test_all_but_the_print_is_closed_and_faces_outwards(variants):
    for parts in variants:
        check_closed(parts, "target")


def test_nothing_of_the_body_is_in_front_of_the_print_s_plane_within_it(variants):
    """The board's own solids stay behind their print, or they would hide it."""
    for parts in variants:
        for part in parts:
            if part.slot in ("board", "bracket"):
                low, high = parts[0].mesh.bounds[:, :2]
                xy = part.mesh.vertices[:, :2]
                within = ((xy > low + 0.5) & (xy < high - 0.5)).all(axis=1)
                assert (part.mesh.vertices[within, 2] < 0).all(), part.slot


def covered(parts, target):
    """Part of each outer disc : (3,) that something hides from a viewer straight above."""
    low, step = -20.0, 0.5
    cells = np.zeros((220, 220), bool)
    for part in parts:
        if part.slot == "target":
            continue
        points = part.mesh.triangles
        points = points[(points[:, :, 2] > 0.2).any(axis=1)]
        inside = ((points[:, :, :2].max(axis=1) > low) & (points[:, :, :2].min(axis=1) < low + 110)).all(axis=1)
        for weights in np.random.default_rng(0).dirichlet([1, 1, 1], 40):  # finer than the cells on triangles of 3 mm
            spots = np.floor((np.einsum("k,nkd->nd", weights, points[inside])[:, :2] - low) / step).astype(int)
            spots = spots[((spots >= 0) & (spots < 220)).all(axis=1)]
            cells[spots[:, 0], spots[:, 1]] = True
    centres = low + step * (np.arange(220) + 0.5)
    x, y = np.meshgrid(centres, centres, indexing="ij")
    radius = target.outer_diameter_mm / 2
    return np.array([cells[np.hypot(x - cx, y - cy) < radius].mean() for cx, cy in discs(target)])


def test_a_quarter_of_the_variants_hide_a_part_of_a_circle(variants, rig):
    """28 % are meant to (some of those miss); 14 draws deviate by 12 % (one sigma). Hardly any hides all three circles."""
    hidden = np.array([covered(parts, rig.target) for parts in variants])
    some = (hidden > 0.02).any(axis=1)
    assert 0.08 <= some.mean() <= 0.5
    assert ((hidden > 0.5).all(axis=1)).mean() < 0.1


def test_nothing_covers_a_circle_unless_asked_to(rig):
    ranges = Ranges(cable_in_front=0, finger_in_front=0, robot=0.3)
    for k in range(4):
        parts = held(np.random.default_rng([9, k]), rig.target, ranges)
        assert covered(parts, rig.target).max() < 0.02, k


def test_most_variants_have_a_hand_and_some_have_none(variants):
    hands = np.mean([any(part.slot == "skin" for part in parts) for parts in variants])
    assert 0.6 < hands < 1


def test_a_variant_is_small_and_near(variants):
    for parts in variants:
        assert sum(len(part.mesh.faces) for part in parts) <= 30_000
        for part in parts:
            if part.slot in ("board", "probe", "marking"):
                assert np.abs(part.mesh.vertices).max() < 280, part.slot


def test_the_same_seed_gives_the_same_bytes(rig):
    once, twice = (merged(held(np.random.default_rng(3), rig.target)) for _ in range(2))
    for name in ("vertices", "normals", "faces", "slot"):
        assert getattr(once, name).tobytes() == getattr(twice, name).tobytes()


EYES = np.array([[60.0, -40, 600], [-120, 30, 600], [0, 250, 520]])  # in the target's frame


@pytest.fixture(scope="module")
def designed(rig):
    return [as_designed(np.random.default_rng([7, k]), rig.target, rig.probe, EYES) for k in range(3)]


def test_the_array_s_face_lies_where_the_b_scan_begins(designed, rig):
    """Depth is counted from the face of the acoustic lens: it reaches the image's top line to 0.1 mm over the whole array."""
    image_from_target = rigid.invert(rig.probe.target_from_image.matrix())
    width = rig.probe.scale_mm_per_px[0] * (rig.probe.image_size[0] - 1)
    for parts in designed:
        body = [part.mesh for part in parts if part.slot in ("probe", "marking")]
        points = rigid.apply(image_from_target, np.concatenate([mesh.vertices for mesh in body]))
        assert points[:, 1].max() == pytest.approx(0.0, abs=0.1), "nothing of the probe reaches into the image"
        face = points[points[:, 1] > -0.1]
        assert face[:, 0].min() < 1.0 and face[:, 0].max() > width - 1.0
        assert face[:, 2].mean() == pytest.approx(0.0, abs=0.1), "the image plane is in the middle of the lens"


@pytest.mark.slow
def test_a_hand_leaves_lines_of_sight_free(rig):
    """To a board beside the probe, which hands of the same draws cover else; no line of sight comes to skin or sleeve."""
    there, ways = np.array([-150.0, 60.0, -40.0]) + 9 * np.random.default_rng(3).standard_normal((30, 3)), EYES[[0, 1] * 15]
    views, met = np.stack([ways, there], axis=1), []
    for free in (None, views):
        made = [as_designed(np.random.default_rng([7, k]), rig.target, rig.probe, EYES, free) for k in range(8)]
        hands = [[part.mesh for part in parts if part.slot in ("skin", "sleeve")] for parts in made]
        assert sum(map(bool, hands)) > 2
        met.append([_meets(trimesh.util.concatenate(hand), views) for hand in hands if hand])
    assert any(met[0]) and not any(met[1])


def _meets(mesh, views):
    """Whether points of a mesh lie within 5 mm of lines of sight."""
    way = views[:, 1] - views[:, 0]
    to_point = mesh.vertices[:, None] - views[:, 0]
    share = np.clip((to_point * way).sum(-1) / (way**2).sum(-1), 0, 1)
    return (np.linalg.norm(to_point - share[..., None] * way, axis=-1) < 5).any()


def test_a_designed_body_has_the_board_of_the_rig_behind_it(designed, rig):
    middle = np.array([rig.target.c1_mm, rig.target.c2_mm]) / 2
    for parts in designed:
        low, high = parts[0].mesh.bounds[:, :2]
        assert high - low == pytest.approx(rig.target.board_mm) and (low + high) / 2 == pytest.approx(middle)
        check_closed(parts, "target")


def blocked(mesh, starts, ends):
    """Whether a segment meets a triangle : (n,) [Moller & Trumbore 1997]."""
    corner, first, second = mesh.triangles[:, 0], *(mesh.triangles[:, k] - mesh.triangles[:, 0] for k in (1, 2))
    hit = []
    for start, way in zip(starts, ends - starts, strict=True):
        across = np.cross(way, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (across * first).sum(axis=1)
            away = start - corner
            u = (away * across).sum(axis=1) * inverse
            turned = np.cross(away, first)
            v, t = turned @ way * inverse, (turned * second).sum(axis=1) * inverse
        hit.append(bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any()))
    return np.array(hit)


def test_a_designed_body_is_mostly_in_a_hand_and_no_circle_is_covered(designed, rig):
    turn = DIRECTIONS[::4]  # 3 mm from ray to ray, narrower than a finger or a cable
    rims = discs(rig.target)[:, None] + 9.0 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    rims = np.column_stack([rims.reshape(-1, 2), np.full(rims.size // 2, 0.2)])
    for parts in designed:
        hands = trimesh.util.concatenate([part.mesh for part in parts if part.slot not in ("target", "cable")])
        for eye in EYES:
            assert not blocked(hands, rims, np.tile(eye, (len(rims), 1))).any()
    assert np.mean([any(part.slot == "skin" for part in parts) for parts in designed]) >= 0.5


def test_a_probe_that_would_pierce_its_board_is_refused(rig):
    near = rig.probe.target_from_image.model_copy(update={"translation_mm": (-20.0, 16.5, -48.0)})
    probe = rig.probe.model_copy(update={"target_from_image": near})
    with pytest.raises(
        InputError, match=r"rig.probe.target_from_image: .* clear of it, found its middle at \(-?0, 15, -4\d\) mm"
    ):
        as_designed(np.random.default_rng(0), rig.target, probe, EYES)
