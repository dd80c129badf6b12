"""Where the sound of a sweep went, against closed forms."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.segmentation import insonation
from recon.segmentation.echo_power import SLICE_MM, SPREAD_MM
from tests.recon.pose_stacks import MM, SCALE, SHAPE, crossing, stack, sweep, voxel


def inner(where, mm=4.0):
    """Voxels well within the hull."""
    places = insonation.centres(where.grid)
    low, high = np.array([mm, 3 + mm, -15 + mm]), np.array([40 - mm, 40 - mm, 15 - mm])
    return ((places > low) & (places < high)).all(axis=-1)


@pytest.mark.parametrize("spacing", [0.5, 1.0, 2.0])
def test_a_static_stack_is_counted_by_its_spacing(spacing):
    """A voxel of 2 mm holds 2 mm over the spacing B-scans; one hull that is as large as what they show."""
    where = insonation.of_sweep(stack(np.arange(-15, 15 + spacing / 2, spacing)), SHAPE)
    chosen = inner(where)
    np.testing.assert_allclose(where.count[chosen], 2 / spacing, atol=1e-6)
    assert not where.gap_mm[chosen].any() if spacing < 0.6 else (where.gap_mm[chosen] <= spacing).all()
    np.testing.assert_allclose(where.seen[chosen], 1)
    assert where.hull.sum() * where.voxel_mm3 == pytest.approx(40 * 40 * 30, rel=0.12)
    assert not (where.hull & ~where.around).any() and where.around.sum() > 1.5 * where.hull.sum()


def test_a_beams_depth_and_direction_are_those_of_its_pose():
    turn = Rotation.from_rotvec([0.3, 0.2, 0.1])
    matrices = rigid.transform(turn.as_matrix(), [5, -7, 600]) @ stack(np.arange(-15, 15.1, 0.5))
    where = insonation.of_sweep(matrices, SHAPE, face_row=8)
    known = where.count > 0
    local = rigid.apply(np.linalg.inv(matrices[30] @ np.linalg.inv(SCALE)), insonation.centres(where.grid))
    np.testing.assert_allclose(where.depth_mm[known], local[known][:, 1] - 8 * MM, atol=1e-3)
    np.testing.assert_allclose(where.beam[known], np.broadcast_to(turn.apply([0, 1, 0]), (known.sum(), 3)), atol=1e-5)
    assert where.turned_deg[known].max() < 0.1 and np.isnan(where.depth_mm[~known]).all()


def test_beams_from_two_sides_scatter_by_their_angle():
    """At +- 10 degrees, half of each: the standard deviation is 10 degrees."""
    tilted = [rigid.from_rotation_vector([np.deg2rad(a), 0, 0], [0, 0, 0]) @ stack(np.arange(-15, 15.1, 0.5)) for a in (-10, 10)]
    where = insonation.of_sweep(np.concatenate(tilted), SHAPE)
    both = where.turned_deg[voxel(where, [20, 10, 0])]
    assert both == pytest.approx(10, rel=0.05)


@pytest.mark.parametrize(("depth", "sigma"), SLICE_MM[2:6])
def test_the_resolution_is_that_of_beam_slice_and_spacing(depth, sigma):
    """Across: the slice's variance and that of even places between B-scans 1 mm apart, spacing squared over 12."""
    where = insonation.of_sweep(stack(np.arange(-15, 15.1, 1.0)), SHAPE)
    k, _, i = voxel(where, [20, 20, 0])
    at = where.grid.origin[1] + 2.0 * np.arange(where.grid.size[1])
    found = np.interp(depth, at, where.elevational_mm[k, :, i])
    assert found == pytest.approx(np.hypot(sigma, 1 / np.sqrt(12)), abs=0.04)  # by the slice's bends between voxels
    assert np.interp(depth, at, where.lateral_mm[k, :, i]) == pytest.approx(SPREAD_MM[0], rel=1e-3)
    assert where.axial_mm == SPREAD_MM[1]


def test_strokes_that_cross_improve_the_worst_direction():
    """At right angles both are coarsest between them: the mean of the variances along and across."""
    places = np.arange(-15, 15.1, 1.0)
    one = insonation.of_sweep(stack(places), SHAPE)
    both = insonation.of_sweep(np.concatenate([stack(places), crossing(places)]), SHAPE)
    single, double = (where.elevational_mm[voxel(where, [20, 30, 0])] for where in (one, both))
    assert double == pytest.approx(np.sqrt((single**2 + SPREAD_MM[0] ** 2) / 2), rel=0.06)
    cells = [where.cells[voxel(where, [20, 30, 0])] for where in (one, both)]
    assert cells[1] == pytest.approx(2 * cells[0], rel=0.2), "B-scans from elsewhere have other speckle"


def test_speckle_cells_are_those_of_the_slice_or_of_the_spacing():
    """B-scans farther apart than the slice are each independent; nearer ones give no more than the slice holds."""
    cell = 2 * np.sqrt(np.pi)
    for spacing, length in ((0.1, cell * 0.37), (3.0, 3.0)):
        where = insonation.of_sweep(stack(np.arange(-15, 15.1, spacing)), SHAPE)
        found = where.cells[inner(where) & (np.abs(where.depth_mm - 30) < 1.1)].mean()
        assert found == pytest.approx(1 / (cell**2 * SPREAD_MM[0] * SPREAD_MM[1] * length), rel=0.1)


@pytest.mark.parametrize(("gap_mm", "bridged"), [(3.0, True), (6.0, False), (15.0, False)])
def test_a_gap_is_as_wide_as_b_scans_are_apart(gap_mm, bridged):
    places = np.concatenate([np.arange(-15, -gap_mm / 2 + 0.01, 0.5), np.arange(gap_mm / 2, 15.1, 0.5)])
    where = insonation.of_sweep(stack(places), SHAPE)
    k, j, i = voxel(where, [20, 20, 0])
    assert where.gap_mm[k, j, i] == pytest.approx(gap_mm, abs=0.6)
    assert (where.seen[k, j, i] == 1) == bridged
    assert where.hull[k, j, i], "it was scanned around"


def test_poses_that_are_not_numbers_are_left_out(rng):
    matrices = sweep(rng)
    lost = np.insert(matrices, [3, 7, 20], np.nan, axis=0)
    with_lost, without = (insonation.of_sweep(one, SHAPE) for one in (lost, matrices))
    np.testing.assert_array_equal(with_lost.count, without.count)
    np.testing.assert_array_equal(with_lost.cells, without.cells)


def test_no_pose_at_all_is_refused():
    with pytest.raises(InputError, match="poses: expected at least one that is valid"):
        insonation.of_sweep(np.full((3, 4, 4), np.nan), SHAPE)


@pytest.mark.parametrize(("count", "found"), [(3, "fewer"), (5, "more")])
def test_images_are_as_many_as_poses(count, found):
    with pytest.raises(InputError, match=f"images: expected as many as poses, 4, found {found}"):
        insonation.of_sweep(stack(np.arange(4.0)), SHAPE, [np.full(SHAPE, 90, np.uint8)] * count)


def test_more_b_scans_never_harm(rng):
    matrices = sweep(rng)
    grid = insonation.grid_around(matrices, SHAPE)
    tally = insonation.begin(grid, SHAPE)
    before = insonation.insonation(tally)
    for matrix in matrices[rng.permutation(len(matrices))]:
        insonation.add(tally, matrix)
        after = insonation.insonation(tally)
        assert (after.count >= before.count).all() and (after.seen >= before.seen).all()
        assert (after.cells >= before.cells - 1e-5).all() and (after.elevational_mm <= before.elevational_mm + 1e-6).all()
        before = after


def test_lines_without_contact_and_what_lies_behind_the_tissue_are_not_seen():
    """The right half of the array shows nothing, and tissue ends 25 mm deep; a dark mass above its end is seen."""
    image = np.zeros(SHAPE, np.uint8)
    image[: round(25 / MM), :80] = 100
    image[40:70, 20:50] = 0
    matrices = stack(np.arange(-15, 15.1, 0.5))
    where = insonation.of_sweep(matrices, SHAPE, [image] * len(matrices))
    counts = [where.count[voxel(where, place)] for place in ([9, 15, 0], [9, 21, 0], [9, 30, 0], [32, 15, 0])]
    assert counts[0] > 0 and counts[1] > 0 and counts[2] == counts[3] == 0


def tissue_of(image):
    """Pixels that show tissue, 0.25 mm large."""
    return insonation.tissue(image, (MM, MM))


def test_a_bright_strip_below_a_shadow_does_not_make_it_seen():
    """What is dark for more than 12 mm is a shadow, and what is dark for less may be a mass; the strip itself was seen."""
    image = np.full(SHAPE, 120, np.uint8)
    image[40:136, 40:80] = 8  # 24 mm
    image[40:72, 100:140] = 8  # 8 mm
    found = tissue_of(image)
    assert not found[44:132, 42:78].any() and found[140:, 42:78].all() and found[12:36, 42:78].all()
    assert found[12:, 100:140].all()


@pytest.mark.parametrize(("drop_db", "seen"), [(5, True), (12, False)])
@pytest.mark.parametrize("range_db", [50, 80])
def test_noise_behind_the_tissue_is_not_seen(drop_db, seen, range_db):
    """Some dB below the tissue: grey levels are logarithms, so half of one may be 15 or 25 dB below."""
    image = np.full(SHAPE, 120, np.uint8)
    image[104:] = 120 - round(drop_db * 255 / range_db)
    found = insonation.tissue(image, (MM, MM), dynamic_range_db=range_db)
    assert found[12:100].all() and found[108:].all() == found[108:].any() == seen


def test_what_lies_beside_a_fan_is_not_seen(rng):
    """A trapezium that widens from 12 to 40 mm, to half a millimetre; a black cyst in its middle was seen."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    half = (6 + 14 * v / SHAPE[0]) / MM
    inside = np.abs(u - 79.5) < half
    image = np.where(inside, rng.rayleigh(90, SHAPE).clip(1, 255), 0).astype(np.uint8)
    image[(u - 80) ** 2 + (v - 90) ** 2 < 12**2] = 0
    found = tissue_of(image)
    assert not found[np.abs(u - 79.5) > half + 2].any()
    assert found[(np.abs(u - 79.5) < half - 4) & (v >= 12)].all()
    where = insonation.of_sweep(stack(np.arange(-15, 15.1, 0.5)), SHAPE, [image] * 61)
    assert where.seen[voxel(where, [4, 8, 0])] == 0 and where.seen[voxel(where, [20, 8, 0])] == 1
    assert where.room_mm[voxel(where, [4, 8, 0])] < 0, "no mass is sought there"


@pytest.mark.parametrize("face_row", [-60, 40])
def test_ringing_and_depths_begin_at_the_face(face_row):
    """One 10 mm down in the image rings down to 13 mm; one 15 mm above a clip doesn't show its ringing."""
    where = insonation.of_sweep(stack(np.arange(-15, 15.1, 0.5)), SHAPE, face_row=face_row)
    y = insonation.centres(where.grid)[..., 1]
    k, _, i = voxel(where, [20, 20, 0])
    assert y[k, where.count[k, :, i] > 0, i].min() == pytest.approx(13 if face_row > 0 else 0, abs=1.01)
    np.testing.assert_allclose(where.under_mm[where.hull], (y - face_row * MM)[where.hull], atol=1e-3)


@pytest.mark.parametrize("image", [np.full((80, 160), 90, np.uint8), np.full((*SHAPE, 3), 90, np.uint8), np.full(SHAPE, 90.0)])
def test_images_of_another_size_or_colour_are_refused(image):
    with pytest.raises(InputError, match="image: expected 160x160 px of 8-bit grey, found") as error:
        insonation.of_sweep(stack([0.0, 1.0]), SHAPE, [image] * 2)
    assert "\n" not in str(error.value)


def test_places_are_under_the_skin():
    """A skin 6 mm below the face: the gel above it isn't scanned. Without one, places are below the face."""
    x, z = np.meshgrid(np.linspace(-30, 70, 101), np.linspace(-50, 50, 101))
    points = np.column_stack([x.ravel(), np.full(x.size, 6.0), z.ravel()])
    a = np.arange(101 * 101).reshape(101, 101)
    corners = [a[:-1, :-1], a[:-1, 1:], a[1:, :-1], a[1:, :-1], a[:-1, 1:], a[1:, 1:]]
    skin = trimesh.Trimesh(points, np.stack(corners, axis=-1).reshape(-1, 3), process=False)
    down = rigid.transform(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), [0, 0, 600])  # the beam away from the camera
    matrices = stack(np.arange(-15, 15.1, 0.5))
    bare = insonation.of_sweep(down @ matrices, SHAPE)
    under = insonation.of_sweep(down @ matrices, SHAPE, skin=skin.copy().apply_transform(down))
    local = rigid.apply(np.linalg.inv(down), insonation.centres(under.grid))
    np.testing.assert_allclose(under.under_mm[under.around], local[under.around][:, 1] - 6, atol=1e-3)
    np.testing.assert_allclose(bare.under_mm[bare.around], local[bare.around][:, 1], atol=1.01)  # half a voxel
    assert local[under.hull][:, 1].min() >= 6 and bare.hull.sum() > under.hull.sum()


def test_a_tally_that_grows_is_the_same(rng):
    """As if the grid had been larger from the beginning."""
    matrices = sweep(rng)
    small = insonation.begin(insonation.grid_around(matrices[:3], SHAPE), SHAPE)
    for matrix in matrices[:3]:
        insonation.add(small, matrix)
    large = insonation.grown(small, (2, 3, 16))
    again = insonation.begin(large.grid, SHAPE)
    for matrix in matrices[:3]:
        insonation.add(again, matrix)
    for one, other in zip((*large.sums, large.marks), (*again.sums, again.marks), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_memory_grows_with_voxels_alone(rng):
    """130 bytes a voxel, however many B-scans; and what would take more than half a GB is refused."""
    grid = insonation.grid_around(sweep(rng), SHAPE)
    tally = insonation.begin(grid, SHAPE)
    assert sum(one.nbytes for one in (*tally.sums, tally.marks)) < 130 * np.prod(grid.size)
    with pytest.raises(InputError, match="map of what was seen: expected at most 4000000 voxels"):
        insonation.begin(insonation.widened(grid, (100, 100, 100)), SHAPE)


def test_marks_and_sums_are_those_of_a_plain_loop(rng):
    """The slow twin: every part of a voxel against every B-scan."""
    matrices = sweep(rng, 6)
    tally = insonation.begin(insonation.grid_around(matrices, SHAPE, 4.0), SHAPE)
    for matrix in matrices:
        insonation.add(tally, matrix)
    nx, ny, nz = tally.grid.size
    k, j, i = np.indices(tally.marks.shape)
    parts = np.array(insonation.PARTS[::-1])
    places = rigid.apply(insonation.world_from_voxel(tally.grid), (np.stack([i, j, k], axis=-1) + 0.5) / parts - 0.5)
    passed = np.zeros(tally.marks.shape, bool)
    for matrix in matrices:
        normal = np.cross(matrix[:3, 0], matrix[:3, 1])
        normal /= np.linalg.norm(normal)
        half = np.abs(normal @ tally.grid.directions) @ (tally.grid.spacing / parts) / 2
        local = (places - matrix[:3, 3]) @ matrix[:3, :2] / MM**2
        shown = (local > -0.5).all(axis=-1) & (local < 159.5).all(axis=-1) & (local[..., 1] >= 12)
        passed |= shown & (np.abs((places - matrix[:3, 3]) @ normal) < half)
    assert (passed != (tally.marks > 0)).mean() < 1e-5
    assert tally.sums.count.shape == (nz, ny, nx)
