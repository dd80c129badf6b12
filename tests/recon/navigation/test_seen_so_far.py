"""The live map: the same as that of the whole sweep, and places that vanish as they are seen."""

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from recon.geometry import rigid
from recon.navigation import seen_so_far
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.seen_so_far import Mapper, RunningMap
from recon.segmentation import echo_power, insonation, rough_bodies, seen_map
from recon.segmentation.detectability import Sought
from recon.segmentation.masses import SPACING_MM
from tests.recon.navigation.live_stand_ins import until
from tests.recon.pose_stacks import MM, SHAPE, stack, sweep

GREY = np.full(SHAPE, 90, np.uint8)
DOWN = rigid.transform(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), [0, 0, 600])  # the beam away from camera 1


def scans(matrices, image=GREY):
    return [PlacedScan(image, number, number, matrix) for number, matrix in enumerate(matrices)]


def flat_skin(half_mm=(40.0, 45.0)):
    """A plane at the array's face, around the middle of it."""
    x, z = (np.linspace(-half, half, 61) for half in half_mm)
    points = np.stack([*np.meshgrid(x + 20, z), np.zeros((61, 61))], axis=-1)[..., [0, 2, 1]].reshape(-1, 3)
    a = np.arange(61 * 61).reshape(61, 61)
    corners = [a[:-1, :-1], a[:-1, 1:], a[1:, :-1], a[1:, :-1], a[:-1, 1:], a[1:, 1:]]
    return trimesh.Trimesh(rigid.apply(DOWN, points), np.stack(corners, axis=-1).reshape(-1, 3), process=False)


@pytest.mark.parametrize("apart_mm", [0.0, 130.0])
def test_the_running_map_is_that_of_the_whole_sweep(apart_mm, rng):
    """In another order, too, and though its grid grows: a second stroke lies far beside the first."""
    matrices = sweep(rng, 40)
    matrices[20:, 0, 3] += apart_mm
    live = RunningMap()
    for scan in scans(matrices):
        live.add(scan)
    at_once = insonation.begin(live.tally.grid, SHAPE)
    for matrix in matrices[rng.permutation(len(matrices))]:
        insonation.add(at_once, matrix, GREY)
    for one, other in zip((*live.tally.sums, live.tally.marks), (*at_once.sums, at_once.marks), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    maps = [seen_map.probability(insonation.insonation(tally), Sought(), 0.8) for tally in (live.tally, at_once)]
    np.testing.assert_allclose(*maps, atol=1e-4)


def test_points_vanish_as_they_are_seen():
    """Under a skin the planned volume stays, the share rises, and points lie where no B-scan was."""
    live = RunningMap(flat_skin())
    matrices = DOWN @ stack(np.arange(-30, 30.1, 0.5))
    shares, planned = [0.0], set()
    for number, scan in enumerate(scans(matrices)):
        live.add(scan)
        if number % 40 == 0:
            found = live.seen()
            shares.append(found.share)
            planned.add(found.planned_mm3)
    assert len(planned) == 1 and (np.diff(shares) >= 0).all() and 0.15 < shares[-1] < 0.6
    local = rigid.apply(np.linalg.inv(DOWN), live.seen().points.astype(float))
    amid = (np.abs(local[:, 0] - 20) < 12) & (np.abs(local[:, 2]) < 22)
    assert not amid.any() and len(local) > 100, "all amid the sweep is seen, from below the ringing to the lower end"
    assert local[:, 1].min() > 3 and local[:, 1].max() < 40 and local[:, 0].max() > 45


def test_without_a_skin_what_lies_around_counts():
    """A B-scan alone sees no mass whole; a stroke does, and beside it is still to be scanned."""
    live = RunningMap()
    assert live.seen() is None
    matrices = stack(np.arange(-15, 15.1, 0.5))
    live.add(scans(matrices)[0])
    assert live.seen().share == 0
    for scan in scans(matrices)[1:]:
        live.add(scan)
    found = live.seen()
    assert 0.1 < found.share < 0.6
    assert found.points[:, 0].max() > 42 and found.points[:, 2].min() < -18


AIR = np.zeros(SHAPE, np.uint8)
AIR[:6] = 200  # ringing


def test_b_scans_in_the_air_neither_begin_the_map_nor_enlarge_it():
    live = RunningMap()
    live.add(scans(stack([0]), AIR)[0])
    assert live.tally is None
    for scan in scans(stack(np.arange(-15, 15.1, 0.5))):
        live.add(scan)
    before, size = live.tally.sums.count.copy(), live.tally.grid.size
    for place in (0, 5000):
        live.add(scans(stack([place]), AIR)[0])
    np.testing.assert_array_equal(live.tally.sums.count, before)
    assert live.tally.grid.size == size and live.left_out == 0


@pytest.mark.parametrize(
    ("image", "place", "why"),
    [
        (np.full((80, 80), 90, np.uint8), 0, "image: expected 160x160 px of 8-bit grey, found 80x80 of uint8"),
        (np.full((*SHAPE, 3), 90, np.uint8), 0, "image: expected 160x160 px of 8-bit grey, found 160x160x3 of uint8"),
        (GREY, 5000, "map of what was seen: expected at most 4000000 voxels"),
    ],
)
def test_what_does_not_fit_is_left_out_and_logged_once(image, place, why, caplog):
    """Of another size, in colour, or too far away; the map of the others goes on."""
    live, matrices = RunningMap(), stack(np.arange(-15, 15.1, 0.5))
    for number, matrix in enumerate(matrices):
        live.add(scans([matrix])[0])
        if number in (1, 5, 9):
            live.add(scans(stack([place + number]), image)[0])
    assert live.left_out == 3 and live.seen().share > 0.1
    (record,) = caplog.records
    assert why in record.getMessage() and "\n" not in record.getMessage()


def test_a_map_does_not_begin_by_a_colour_image(caplog):
    live = RunningMap()
    live.add(scans(stack([0]), np.full((*SHAPE, 3), 90, np.uint8))[0])
    assert live.tally is None and live.left_out == 1 and "8-bit grey" in caplog.text
    live.add(scans(stack([0]))[0])
    assert live.tally is not None


def test_a_first_b_scan_askew_leaves_the_grid_along_the_skin():
    """Turned by 30 degrees: the grid is square to the skin, and holds what lies under it and 10 mm more on all sides."""
    askew = DOWN @ rigid.from_rotation_vector([0.5, 0, 0.1], [0, 0, 0]) @ stack([0])
    live, skin = RunningMap(flat_skin()), flat_skin()
    live.add(scans(askew)[0])
    grid = live.tally.grid
    np.testing.assert_allclose(grid.directions[:, 1], [0, 0, 1], atol=1e-6)
    ends = np.concatenate([skin.vertices, rigid.apply(rigid.transform(np.eye(3), [0, 0, 39.75]), skin.vertices)])
    index = rigid.apply(np.linalg.inv(insonation.world_from_voxel(grid)), ends)
    assert index.min() * 3 >= 9.9 and ((np.array(grid.size) - 1 - index.max(axis=0)) * 3 >= 9.9).all()


@pytest.mark.parametrize("lobules_db", [0.0, 1.5, 4.0])
def test_the_tissues_unevenness_is_that_of_the_whole_sweep(lobules_db, rng):
    """Of single B-scans against all together, of lobules some mm large under speckle, with a mass and its shadow.

    Within 0.3 dB or 15 %, as the level of the tissue around follows lobules more closely in a plane than in space.
    """
    places = np.arange(-15, 15.1, 1.0)
    lobules = ndimage.gaussian_filter(rng.normal(0, 1, (len(places), *SHAPE)), (1.5, 1.5 / MM, 1.5 / MM))
    speckle = ndimage.gaussian_filter(rng.normal(0, 1, (2, len(places), *SHAPE)), (0, 0, 0.09 / MM, 0.28 / MM))
    decibels = lobules_db * lobules / lobules.std() + 10 * np.log10((speckle**2).sum(axis=0))
    images = np.clip(120 + 255 / 60 * (decibels - np.median(decibels)), 1, 255).astype(np.uint8)
    images[10:20, 50:80, 20:50] = 40
    images[10:20, 80:, 30:40] = 10
    live = RunningMap()
    for image, matrix in zip(images, stack(places), strict=True):
        live.add(scans([matrix], image)[0])
    grid = echo_power.beam_grid(stack(places), SHAPE, SPACING_MM)
    whole = rough_bodies.rough(echo_power.averaged(images, stack(places), grid, float(np.median(images)))).uneven_db
    assert live.seen().uneven_db == pytest.approx(whole, abs=0.3, rel=0.15)
    assert whole > 0.7 * lobules_db


def test_a_breast_has_its_own_coefficients_in_the_live_map(monkeypatch):
    """By its unevenness, as in that of the whole sweep."""
    maps = {}
    for uneven_db in (0.8, 4.5):
        live = RunningMap()
        monkeypatch.setattr(seen_so_far, "unevenness", lambda *_, db=uneven_db: db)
        for scan in scans(stack(np.arange(-15, 15.1, 0.5))):
            live.add(scan)
        maps[uneven_db] = live.seen()
    assert maps[4.5].uneven_db == 4.5 and maps[4.5].source != maps[0.8].source


def test_a_thread_maps_all_that_it_is_given():
    mapper = Mapper(RunningMap())
    assert mapper.newest is None
    mapper.start()
    for scan in scans(stack(np.arange(-15, 15.1, 0.5))):
        mapper.add(scan)
    until(lambda: mapper.newest is not None)
    mapper.stop()
    assert mapper.running.tally.sums.count.sum() > 0
    assert mapper.newest.share == mapper.running.seen().share


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_fault_ends_the_map_and_nothing_else(monkeypatch, caplog):
    """Whatever it is: nothing old is shown, nothing is kept, and one line says so."""
    mapper = Mapper(RunningMap())
    mapper.start()
    each = scans(stack(np.arange(-15, 15.1, 0.5)))
    mapper.add(each[0])
    until(lambda: mapper.newest is not None)
    monkeypatch.setattr(insonation, "tissue", lambda *_: np.zeros(0)[1])
    mapper.add(each[1])
    until(lambda: not mapper._thread.is_alive())
    for scan in each:
        mapper.add(scan)
    assert mapper.newest is None and mapper._scans.take(0.0) is None
    assert [record.getMessage() for record in caplog.records] == ["what was seen isn't mapped any more"]
    mapper.stop()
