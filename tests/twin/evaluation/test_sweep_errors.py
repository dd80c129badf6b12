"""Are the errors of a sweep what they are known to be?"""

import json
import shutil

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.geometry import rigid
from sonotwin.config import compose
from tests.twin import drawn_sweep
from tests.twin.drawn_sweep import PROBE_MM, SHIFT, SIZE, TUMOURS, ball
from twin.conditions import Sound, speeds
from twin.evaluation import sweep_errors


@pytest.fixture(scope="module")
def truth(rig, tmp_path_factory):
    return drawn_sweep.true_sweep(tmp_path_factory.mktemp("truth") / "labels", rig)


def test_a_tumour_that_is_off_is_told_by_how_much(truth):
    """Shifted by 0.5 mm: the outline's error is the shift's part along the normal, 0.5 / sqrt(3) RMS."""
    found = [ball(TUMOURS[0][0] + SHIFT, TUMOURS[0][1])]
    figures = sweep_errors.measure(sweep_errors.compare(found, truth.hidden), truth, drawn_sweep.segmented(found, truth))
    assert figures["tumour0_centre_error_mm"] == pytest.approx(0.5, abs=1e-3)
    assert figures["tumour0_outline_rms_mm"] == pytest.approx(0.5 / np.sqrt(3), rel=0.03)
    assert abs(figures["tumour0_outline_bias_mm"]) < 0.02
    x = 0.5 / (2 * TUMOURS[0][1])
    assert figures["tumour0_dice"] == pytest.approx(1 - 1.5 * x + 0.5 * x**3, abs=0.01), "of two equal balls that far apart"
    assert (figures["tumours_found"], figures["tumours_true"], figures["tumours_false"]) == (1, 2, 0)
    assert np.isnan(figures["tumour1_centre_error_mm"]) and figures["tumour1_true_extent_mm"] == pytest.approx(8, abs=0.02)


def test_a_tumour_that_is_too_large_has_a_bias(truth):
    """By 0.6 mm all around: so its outline is off, and the tissue above it is less by as much."""
    middle, radius = TUMOURS[1]
    found = [ball(middle, radius + 0.6)]
    figures = sweep_errors.measure(sweep_errors.compare(found, truth.hidden), truth, drawn_sweep.segmented(found, truth))
    assert figures["tumour1_outline_bias_mm"] == pytest.approx(0.6, abs=0.02)
    assert figures["tumour1_extent_mm"] - figures["tumour1_true_extent_mm"] == pytest.approx(1.2, abs=0.01)
    assert figures["tumour1_volume_mm3"] == pytest.approx(4 / 3 * np.pi * (radius + 0.6) ** 3, rel=0.01)
    assert figures["tumour1_true_under_skin_mm"] - figures["tumour1_under_skin_mm"] == pytest.approx(0.6, abs=0.1)
    assert figures["tumour1_inside"] == 1


def test_each_finding_is_given_to_one_tumour_and_what_is_far_away_is_false(truth):
    near, far = (ball(TUMOURS[1][0] + [0, shift, 0], 3.0) for shift in (1.0, 15.0))
    findings = sweep_errors.compare([far, near], truth.hidden)
    assert [finding.found for finding in findings] == [None, near]
    figures = sweep_errors.measure(findings, truth, drawn_sweep.segmented([far, near], truth))
    assert (figures["tumours_found"], figures["tumours_false"]) == (1, 1)


def test_nothing_found_is_told_too(truth):
    figures = sweep_errors.measure(sweep_errors.compare([], truth.hidden), truth, drawn_sweep.segmented([], truth))
    assert (figures["tumours_found"], figures["tumours_true"]) == (0, 2)
    assert np.isnan(figures["tumour0_inside"]) and figures["tumour0_true_under_skin_mm"] > 0


def test_a_shift_of_the_images_is_the_error_of_their_pixels(truth):
    """Also of one corner alone, when the image is turned about another; without a pose there is no error."""
    pixels = truth.world_from_image @ np.diag([*truth.transducer.scale_mm_per_px, 1, 1])
    moved = rigid.transform(np.eye(3), [0.3, 0.0, 0.4]) @ pixels
    moved[4] = np.nan
    apart = sweep_errors.placement(moved, truth)
    assert np.isnan(apart[4]).all() and np.delete(apart, 4, axis=0) == pytest.approx(np.full((12, 5), 0.5))
    turned = truth.world_from_image @ rigid.from_rotation_vector([0, 0, 0.01], np.zeros(3))
    apart = sweep_errors.placement(turned @ np.diag([*truth.transducer.scale_mm_per_px, 1, 1]), truth)
    width = (truth.transducer.image_size[0] - 1) * truth.transducer.scale_mm_per_px[0]
    assert apart[:, 1] == pytest.approx(np.zeros(13), abs=1e-9) and apart[:, 2] == pytest.approx(
        np.full(13, 0.01 * width), rel=1e-3
    )


def test_the_error_of_a_calibration_is_where_it_puts_pixels(truth):
    error, sigma = sweep_errors.probe_errors(drawn_sweep.calibrated(truth), truth, np.array([[0.0, 0.0], [79.0, 109.0]]))
    assert error == pytest.approx([PROBE_MM, PROBE_MM])
    assert (sigma > np.sqrt(3) * 0.1).all() and sigma[1] > sigma[0], "the scales' part grows with u and v"


def test_the_nearest_image_is_one_that_shows_the_point(truth):
    pixels = truth.world_from_image @ np.diag([*truth.transducer.scale_mm_per_px, 1, 1])
    middle = TUMOURS[0][0]
    assert sweep_errors.nearest_frame(middle + np.array([0, 2.2, 0]), pixels, SIZE) == 8
    assert sweep_errors.nearest_frame(middle + np.array([50, 0, 0]), pixels, SIZE) is None


def test_a_body_holds_what_lies_between_its_faces():
    """Also one with a hollow, in which normals at the nearest vertex would mislead: as many points as its volume has."""
    shell = trimesh.util.concatenate([ball(np.zeros(3), 9.0), trimesh.Trimesh(*inside_out(ball(np.array([2.0, 0, 0]), 5.0)))])
    axes = [np.arange(-10, 10, 0.5) + shift for shift in (0.01, 0.02, 0.03)]
    held = sweep_errors.filled(shell, axes)
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    true = (x**2 + y**2 + z**2 < 81) & ((x - 2) ** 2 + y**2 + z**2 > 25)
    assert (held != true).sum() < 0.01 * true.sum(), "facets of 0.6 mm lie within 0.01 mm of the balls"


def inside_out(mesh):
    return mesh.vertices, mesh.faces[:, ::-1]


def test_a_closed_mesh_is_opened_to_the_cameras():
    box = trimesh.creation.box([10, 10, 10])
    assert sweep_errors.facing(box).triangles_center[:, 2] == pytest.approx([-5, -5])


def settings(**more) -> str:
    parts = {"scene": {"kind": "breast", "edge_mm": 5.0}, "clocks": {}, "seed": 3}
    composed = compose("sweep", ["out=none"])
    return json.dumps({name: composed[name] for name in ("rig", "ultrasound")} | parts | more)


def write_truth(folder, text: str) -> None:
    (folder / "sweep" / "labels").mkdir(parents=True)
    (folder / "settings.json").write_text(text, encoding="utf-8")
    np.savez(folder / "sweep/sweep.npz", world_from_image=np.tile(np.eye(4), (2, 1, 1)))
    for number in range(2):
        (folder / f"sweep/labels/{number:04d}.png").write_bytes(b"")


def test_the_truth_has_the_speeds_of_sound_that_were_drawn(tmp_path):
    """Those of the seed and the conditions; a truth of before conditions has the usual ones."""
    sound = Sound(tissue=0.02, water_c=0.5)
    write_truth(tmp_path / "life", settings(conditions={"sound": sound.model_dump()}))
    write_truth(tmp_path / "before", settings())
    life, before = (
        {solid.name: solid.tissue.speed for solid in sweep_errors.read_truth(tmp_path / name).body.solids}
        for name in ("life", "before")
    )
    ratio, _ = speeds(sound, 3)
    assert abs(ratio - 1) > 0.005  # so that it says something
    assert life["breast"] == pytest.approx(ratio * before["breast"])


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda folder: (folder / "sweep/sweep.npz").unlink(), "sweep.npz: expected a file, found none"),
        (lambda folder: (folder / "sweep/sweep.npz").write_bytes(b"PK\x03\x04half"), "sweep.npz: expected an npz file"),
        (lambda folder: shutil.rmtree(folder / "sweep/labels"), "0000.png: expected an image of labels, found none"),
        (lambda folder: (folder / "sweep/labels/0001.png").unlink(), "0001.png: expected an image of labels, found none"),
    ],
)
def test_a_damaged_truth_is_refused_in_one_line(damage, complaint, tmp_path):
    write_truth(tmp_path, settings())
    damage(tmp_path)
    with pytest.raises(InputError, match=complaint) as raised:
        sweep_errors.read_truth(tmp_path)
    assert "\n" not in str(raised.value)


def test_a_tumour_that_the_surface_hardly_covers_is_neither_inside_nor_outside(truth):
    found = [ball(TUMOURS[0][0], TUMOURS[0][1])]
    segmented = drawn_sweep.segmented(found, truth) | {"mass0_inside": np.nan}
    figures = sweep_errors.measure(sweep_errors.compare(found, truth.hidden), truth, segmented)
    assert np.isnan(figures["tumour0_inside"]) and sweep_errors.of_each(figures, "inside") == []


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(None, "found none"), ("{", "damaged"), ("[]", "damaged"), (json.dumps({"rig": 3}), "settings.json")],
)
def test_settings_that_are_none_are_refused(content, complaint, tmp_path):
    if content is not None:
        (tmp_path / "settings.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=complaint):
        sweep_errors.read_truth(tmp_path)
