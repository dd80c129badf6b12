"""The map of what was seen: its figures, its surface and its files."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from recon.errors import InputError
from recon.files import volumes
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.segmentation import detectability, insonation, seen_map
from recon.segmentation.detectability import Sought, Threshold
from recon.segmentation.echo_power import SPREAD_MM
from tests.recon.pose_stacks import SHAPE, stack, voxel


@pytest.fixture(scope="module")
def mapped():
    """Two pieces of a stroke, with a gap of 12 mm between them."""
    places = np.concatenate([np.arange(-30, -6 + 0.01, 0.5), np.arange(6, 30.1, 0.5)])
    return seen_map.look(insonation.of_sweep(stack(places), SHAPE))


def test_a_mass_is_seen_within_the_pieces_and_not_in_the_gap(mapped):
    places = {"within": [20, 20, 18], "gap": [20, 20, 0], "cut": [20, 20, 7]}
    at = {name: voxel(mapped.where, place) for name, place in places.items()}
    found = {name: mapped.probability[index] for name, index in at.items()}
    assert found["within"] > 0.6 and found["gap"] < 0.01 and found["cut"] < 0.3
    assert not mapped.unseen[at["within"]] and mapped.unseen[at["gap"]]
    assert mapped.unseen[voxel(mapped.where, [45, 20, 18])], "beside the hull is still to be scanned"
    assert not mapped.room[voxel(mapped.where, [20, 1, 18])], "where a ball would stand out of the skin none is"


@pytest.mark.parametrize("size", [4.0, 8.0, 20.0])
@pytest.mark.parametrize("face_row", [0, 40])
@pytest.mark.parametrize("tilt_deg", [0, 20])
def test_a_perfect_sweep_leaves_nothing_unseen_away_from_its_sides(size, face_row, tilt_deg):
    """Places in the ringing, and within half a mass of it or of the images' lower end, aren't planned; all between are."""
    tilt = rigid.from_rotation_vector([np.deg2rad(tilt_deg), 0, 0], [0, 0, 0])
    where = insonation.of_sweep(tilt @ stack(np.arange(-30, 30.1, 0.25)), SHAPE, face_row=face_row)
    seen = seen_map.look(where, Sought(size, 20.0))
    x, y, z = np.moveaxis(rigid.apply(np.linalg.inv(tilt), insonation.centres(where.grid)), -1, 0)
    away = (np.abs(x - 20) < 18 - size / 2) & (np.abs(z) < 26 - size / 2)
    assert not (seen.unseen & away).any()
    first = max(0, face_row * 0.25) + 3
    assert seen.room[away & (y > first + size / 2 + 4) & (y < 40 - size / 2 - 4)].all() or tilt_deg


def test_a_skin_above_the_gel_does_not_make_the_ringing_a_place():
    """With the skin 20 mm above what is scanned, ringing and lower end limit the planned volume, too."""
    where = insonation.of_sweep(stack(np.arange(-15, 15.1, 0.25)), SHAPE)
    y = insonation.centres(where.grid)[..., 1]
    planned = seen_map.planned(replace(where, under_mm=where.under_mm + 20), 8.0)
    assert y[planned].min() > 3 + 4 and y[planned].max() < 40 - 4


def test_a_line_and_files_say_whether_coefficients_are_assumed(mapped, monkeypatch):
    source = f"by coefficients fitted to {detectability.EVEN.trials} trials"
    assert source in mapped.line and mapped.table.source == source and detectability.source(0) == "by assumed coefficients"
    monkeypatch.setattr(detectability, "GROWN", replace(detectability.EVEN, unseen=Threshold(9, -9), trials=900))
    grown = seen_map.look(mapped.where, uneven_db=3.4)
    assert "by coefficients fitted to 900 trials" in grown.line and grown.table.trials == 900
    assert grown.probability.max() > mapped.probability.max(), "by the coefficients for grown tissue"


def test_the_table_says_how_the_scan_was_insonified(mapped):
    """Medians of a straight sweep along z: from above, in the middle of 3 to 40 mm, by the array's echoes."""
    found = mapped.table.insonified
    assert found.beam == pytest.approx((0, 1, 0), abs=1e-6) and found.turned_deg == pytest.approx(0, abs=0.1)
    assert found.depth_mm == pytest.approx(21.5, abs=1) and found.under_mm == pytest.approx(found.depth_mm, abs=0.1)
    assert (found.lateral_mm, found.axial_mm) == pytest.approx(SPREAD_MM, rel=1e-3)
    assert found.lateral_mm < found.elevational_mm < 1 and found.gap_mm == 0


@pytest.mark.parametrize("shares", [(), ((0.1,),), 5 * ((0.1, 0.2, 0.3),), 4 * (4 * (0.1,),)])
def test_a_table_of_another_shape_is_refused(shares):
    with pytest.raises(ValidationError, match="shares: expected 5 rows with 4 each"):
        seen_map.Table(size_mm=8, contrast_db=8, shares=shares)


def test_figures_are_volumes_of_what_was_scanned(mapped):
    """Of two boxes of 40 x 37 x 24 mm below the ringing, places 4 mm from their sides count, or nearly."""
    figures = mapped.figures
    box = (40 - 8) * (40 - 3 - 8) * (24 - 8)
    assert figures["seen_mm3"] == pytest.approx(2 * box, rel=0.25)
    whole = (mapped.room & mapped.where.hull).sum() * 8
    assert figures["seen_mm3"] + figures["unseen_mm3"] == pytest.approx(whole)
    assert figures["seen_probability"] == pytest.approx(mapped.probability[mapped.room & mapped.where.hull].mean())
    assert mapped.line.startswith("seen        ") and "8 mm and 8 dB" in mapped.line


def test_the_table_rises_with_contrast(mapped):
    """A row a size, a column a contrast; a sought contrast isn't that of the table."""
    shares = np.array(mapped.table.shares)
    assert shares.shape == (len(seen_map.SIZES_MM), len(seen_map.CONTRASTS_DB)) and (np.diff(shares, axis=1) > 0).all()
    assert shares.min() >= 0 and shares.max() < 0.9, "sides and gap were not seen"


def test_the_surface_is_closed_and_holds_what_is_unseen(mapped):
    surface = seen_map.unseen_surface(mapped)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(mapped.unseen.sum() * 8, rel=0.15)


def test_uneven_tissue_hides_more(mapped):
    """Of one observer."""
    uneven = seen_map.look(mapped.where, uneven_db=2.4)
    assert (np.array(uneven.table.shares) <= np.array(mapped.table.shares)).all()
    assert uneven.figures["seen_probability"] < mapped.figures["seen_probability"]


def test_sparse_b_scans_leave_what_another_pass_would_show():
    """The same box in steps of 0.5 and of 3 mm: gaps count as seen, but their blur hides a mass that closer ones would show."""
    close, sparse = (seen_map.look(insonation.of_sweep(stack(np.arange(-30, 30.1, step)), SHAPE)) for step in (0.5, 3.0))
    assert sparse.figures["seen_mm3"] < 0.7 * close.figures["seen_mm3"]
    assert sparse.figures["seen_probability"] < 0.7 * close.figures["seen_probability"]


def test_files_hold_the_map_where_it_is(mapped, tmp_path):
    seen_map.write(tmp_path, mapped)
    found = seen_map.read(tmp_path)
    volume = volumes.read_volume(found.volume)
    np.testing.assert_array_equal(volume.voxels[mapped.room], mapped.probability[mapped.room])
    assert (volume.voxels[~mapped.room] == -1).all(), "outside isn't the same as not found"
    k, j, i = voxel(mapped.where, [20, 20, 18])
    assert rigid.apply(volume.world_from_voxel, [float(i), float(j), float(k)]) == pytest.approx([20, 20, 18], abs=1.01)
    assert found.table == mapped.table and found.unseen.volume == pytest.approx(seen_map.unseen_surface(mapped).volume, rel=1e-3)
    assert seen_map.read(tmp_path / "other") is None
    (tmp_path / seen_map.TABLE).write_text('{"size_mm": -1}')
    with pytest.raises(InputError, match=r"seen\.json"):
        seen_map.read(tmp_path)


def test_a_sweep_without_a_pose_amid_others_has_the_map_of_the_others():
    places = np.arange(-15, 15.1, 0.5)
    matrices = stack(places)
    matrices[[4, 31]] = np.nan
    kept = np.isfinite(matrices).all(axis=(1, 2))
    grey = np.full(SHAPE, 90, np.uint8)
    sweeps = [Scans(SHAPE, some, lambda some=some: iter([grey] * len(some)), 1540, 1540) for some in (matrices, matrices[kept])]
    with_lost, without = map(seen_map.of_scans, sweeps)
    np.testing.assert_array_equal(with_lost.probability, without.probability)
