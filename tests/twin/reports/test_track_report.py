"""Does the report show what was tracked?"""

import html

import cv2
import numpy as np
import pytest

from recon.capture import sweep_tables
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.tracks import Track
from recon.tracking import results
from twin.evaluation import track_errors
from twin.reports import track_report
from twin.tracking.film_session import TRUTH

COUNT, LOST = 8, (4, 5, 7)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Eight frames, of which three were not found, the errors of the others growing by 0.01 mm a frame."""
    root = tmp_path_factory.mktemp("tracked")
    film, track = root / "film", root / "track"
    (film / "truth" / "sweep").mkdir(parents=True)
    (track / results.OVERLAYS).mkdir(parents=True)
    poses = np.tile(rigid.from_rotation_vector([3.1, 0, 0], [0, 0, 650]), (COUNT, 1, 1))
    times = np.arange(COUNT) * 33_000_000
    blur = np.tile(np.array([1.0, 2, 9, 3, 1, 1, 4, 2])[:, None, None], (1, 2, 3))
    inside = np.ones((COUNT, 2, 3), bool)
    inside[list(LOST), 0, 0] = False
    np.savez(
        film / "truth" / "sweep" / TRUTH,
        times_ns=times,
        world_from_target=poses,
        blur_px=blur,
        visible=np.ones((COUNT, 2, 3)),
        inside=inside,
    )
    found = poses.copy()
    found[:, 0, 3] += 0.01 * np.arange(COUNT)
    found[list(LOST)] = np.nan
    sweep_tables.write_track(track / results.POSES, Track(times, found, np.tile(np.diag([1e-8] * 3 + [4e-4] * 3), (COUNT, 1, 1))))
    rows = []
    for k in range(COUNT):
        reason = ("only camera 2 sees the target; <b>" if k < 6 else "no rim") if k in LOST else ""
        rows.append([times[k], k, k, int(not reason), "" if reason else "predicted", *[""] * 6, reason])
        cv2.imwrite(str(track / results.OVERLAYS / f"{k:04d}.jpg"), np.full((64, 160, 3), 100, np.uint8))
    sweep_tables.write_rows(track / results.FRAMES, results.COLUMNS, rows)
    return film / "truth", track


@pytest.fixture(scope="module")
def figures(folders):
    story = track_report.read(*folders)
    sigma = {"track_sigma_median_mm": 0.03, "track_sigma_median_deg": 0.01}
    return track_errors.measure(story.errors, story.truth) | sigma


def test_the_section_tells_what_was_found_and_what_not(folders, figures):
    section = track_report.section(track_report.read(*folders), figures, swept=False)
    text = html.unescape("".join(section.blocks))
    assert "5 of 8 frames, and 5 of the 5" in text and "0 of them wrongly" in text
    assert "4 to 5" in text and "only camera 2 sees the target" in text and "no rim" in text
    swept = track_report.section(track_report.read(*folders), figures | {"point_sigma_mm": 0.02}, swept=True)
    told = html.unescape("".join(swept.blocks))
    assert "While the scanner records" in told and "calibration is by the board" in told and "partly out of" not in told
    assert "calibration is the true one here" in text
    assert "<b>.</b>" not in text and "&lt;b&gt;" in "".join(section.blocks), "what others wrote is text"
    assert text.count("<img") == 4 and text.count("<svg") == 2
    assert "off by 0.020 mm; blurred by 9.0 px" in text


def test_frames_are_chosen_for_what_they_show(folders):
    story = track_report.read(*folders)
    blur = story.truth.blur_px.max(axis=(1, 2))
    assert track_report.chosen(story.errors, blur) == {0: "The first", 2: "The fastest", 5: "One not found", 6: "The last"}


def test_one_sentence_tells_the_result(figures):
    said = track_report.result(figures)
    assert "found in 5 of the 5 frames" in said and "off by 0.020 mm and 0.000°" in said
    assert track_report.result({}) == ""


def test_a_track_without_pictures_is_told_without(folders, figures, tmp_path):
    truth, track = folders
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in (results.POSES, results.FRAMES):
        (bare / name).write_bytes((track / name).read_bytes())
    assert "<img" not in "".join(track_report.section(track_report.read(truth, bare), figures, swept=False).blocks)


def test_tables_that_dont_fit_are_refused(folders, tmp_path):
    truth, track = folders
    (tmp_path / results.POSES).write_bytes((track / results.POSES).read_bytes())
    lines = (track / results.FRAMES).read_text().splitlines(keepends=True)
    (tmp_path / results.FRAMES).write_text("".join(lines[:-1]))
    with pytest.raises(InputError, match="expected 8 frames, found 7"):
        track_report.read(truth, tmp_path)
