"""Are B-scans and their outlines shown where they are?"""

import json

import cv2
import numpy as np
import pytest

from recon.geometry import rigid
from tests.twin import drawn_sweep
from tests.twin.drawn_sweep import CENTRE, IN_TISSUE, LAG_S, SCALE, SHIFT, TUMOURS, ball
from twin.reports import sweep_pictures, sweep_report
from twin.reports.sweep_pictures import FOUND, TRUE, ZOOM


@pytest.fixture(scope="module")
def story(rig, tmp_path_factory):
    return drawn_sweep.inside(tmp_path_factory.mktemp("inside"), rig, np.random.default_rng(7))


def test_a_ball_is_cut_in_a_circle(story):
    """Two mm beside its middle, at the pixels where the image shows it."""
    middle, radius = TUMOURS[0]
    pixels = sweep_pictures.cut(ball(middle, radius), story.world_from_pixel[8]).reshape(-1, 2)
    at = rigid.apply(np.linalg.inv(story.world_from_pixel[8]), middle)
    assert at[2] == pytest.approx(-2) or at[2] == pytest.approx(2)
    distance = np.linalg.norm((pixels - at[:2]) * IN_TISSUE, axis=1)
    assert distance == pytest.approx(np.full(len(pixels), np.sqrt(radius**2 - 4)), abs=0.02)
    assert len(sweep_pictures.cut(ball(middle, 1.0), story.world_from_pixel[8])) == 0


def test_outlines_lie_on_the_edges_of_what_the_image_shows(story):
    """The true one on the edge of the labels, the found one beside it by its shift."""
    number = drawn_sweep.COUNT // 2
    true = sweep_pictures.true_from_pixel(number, story.truth)
    outlines = sweep_pictures.cuts(story.findings, story.world_from_pixel[number], true)
    edge = cv2.distanceTransform(np.uint8(story.truth.shown(number) < 2), cv2.DIST_L2, 5)
    edge += cv2.distanceTransform(np.uint8(story.truth.shown(number) >= 2), cv2.DIST_L2, 5) - 1
    u, v = np.rint(outlines[TRUE].reshape(-1, 2)).astype(int).T
    assert edge[v, u].max() < 1.5
    found, first = outlines[FOUND].reshape(-1, 2), sweep_pictures.cut(story.findings[0].true, story.world_from_pixel[number])
    apart = (found.mean(axis=0) - first.reshape(-1, 2).mean(axis=0)) * IN_TISSUE
    assert apart == pytest.approx(SHIFT[[0, 2]], abs=0.02), "along the array is x, into the depth z"


def test_lines_are_drawn_at_their_pixels_in_their_colour():
    """A line through the middles of pixels of a row lies in the middle of that row, enlarged."""
    picture = sweep_pictures.enlarged(np.zeros((20, 30, 4), np.uint8))
    drawn = sweep_pictures.outlined(picture, {"#ff8040": np.array([[[5.0, 8.0], [20.0, 8.0]]])})
    weight = drawn[:, 12 * ZOOM, 0].astype(float)
    assert (weight @ np.arange(len(weight))) / weight.sum() == pytest.approx(8.5 * ZOOM - 0.5, abs=0.6)
    assert (drawn[8 * ZOOM, 12 * ZOOM] == [255, 128, 64, 255]).all()


def test_the_section_of_the_volume_shows_its_voxels(story):
    """A bright slab of the volume, at the level of the section and only there."""
    voxels = np.ones((40, 40, 40), np.uint8)
    voxels[18:23, 10:20, 5:15] = 250  # z, y, x
    volume = type(story.volume)(voxels, CENTRE - 20, np.ones(3))
    at, below = (sweep_pictures.level_section(volume, CENTRE[2] + off, []) for off in (0.0, 12.0))
    assert at[..., 0].max() == 250 and below[..., 0].max() < 10
    step = sweep_pictures.LEVEL_STEP_MM / ZOOM
    rows, columns = np.nonzero(at[..., 0] > 125)
    assert (rows.mean() * step, columns.mean() * step) == pytest.approx((14.5, 9.5), abs=0.3)


def test_the_view_shows_what_was_found_where_it_is(story):
    """And the truth too, but not at first."""
    points = np.stack(np.meshgrid(np.arange(-20.0, 21), np.arange(-20.0, 21), [630.0]), axis=-1)[:, :, 0].astype(np.float32)
    data = json.loads(sweep_report.view(story, points, np.ones(points.shape[:2], bool)))["data"]
    kinds = {(trace["type"], trace["name"]) for trace in data}
    assert {("mesh3d", "measured surface"), ("mesh3d", "tumours, found"), ("surface", "a B-scan")} < kinds
    true = [trace for trace in data if trace["name"] == "tumours, true"]
    assert len(true) == 2 and all(trace["visible"] == "legendonly" for trace in true)
    assert sum(trace["showlegend"] for trace in true) == 1


def test_the_bottom_is_late_by_lag_times_speed(story):
    """The slope of the drawing's dots is the lag: 1 ms of it is 0.05 mm at the 50 mm/s of the strokes."""
    speed, late = sweep_report.against_speed(story, SCALE[1])
    slope = (speed @ late) / (speed @ speed)
    assert abs(slope) == pytest.approx(LAG_S, abs=0.003)
    assert np.abs(speed).max() > 30 and np.corrcoef(speed, late)[0, 1] > 0.9


def test_what_the_speed_of_sound_does_is_said(story):
    """Silicone's 1450 m/s make 20 mm on the screen 18.8; 10 mm of a tumour, 1530 m/s, are shown as 9.5 of silicone."""
    text = sweep_report.too_deep(story.truth, 1460.0)
    assert "1450 m/s in this tissue" in text and "lies 1.2 mm less deep" in text and "volume are for 1460 m/s" in text
    assert "10 mm of it look 0.5 mm shorter, so its far side is shown above its outline" in text


def test_the_result_tells_of_false_findings(story):
    figures = drawn_sweep.figures(story)
    assert sweep_report.result({}) == ""
    assert "2 more are none" in sweep_report.result(figures | {"tumours_false": 2})
