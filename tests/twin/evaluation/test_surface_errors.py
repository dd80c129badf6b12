"""Errors that are put into a perfect reconstruction come out as they were put in."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry.primitives import Cylinder, Sphere
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.phase import DEFAULT_NOISE
from recon.structured_light.triangulate import triangulate
from sonotwin.cli import main
from sonotwin.verbs.evaluate import describe
from twin.evaluation import surface_errors

SIGMA = 0.03  # mm along the ray


@pytest.fixture(scope="module")
def truth(session):
    return surface_errors.read_truth(session.folder / "truth")


@pytest.fixture
def rays(truth):
    return truth.camera.rays(truth.camera.pixel_grid())


@pytest.fixture
def perfect(truth):
    """The true points where the truth is lit."""
    return np.where(truth.lit[..., None], np.float64(truth.points), np.nan)


def measured(points, truth, sigma=SIGMA):
    comparison = surface_errors.compare(np.float32(points), np.full(truth.lit.shape, sigma, np.float32), truth)
    return surface_errors.measure(np.float32(points), comparison, truth)


def test_a_perfect_reconstruction_has_no_error(truth, perfect):
    metrics = measured(perfect, truth)
    assert metrics["surface_rms_mm"] < 1e-4  # float32 at 700 mm resolves 6e-5 mm
    assert (metrics["coverage"], metrics["gross_error_fraction"], metrics["false_points"]) == (1, 0, 0)
    assert metrics["points"] == truth.lit.sum()


def test_a_shift_outwards_is_a_positive_bias_and_nothing_else(truth, perfect):
    metrics = measured(perfect + 0.05 * truth.normals, truth)
    for name in ("surface_bias_mm", "surface_rms_mm", "surface_median_abs_mm", "thing_ball_rms_mm", "thing_wall_rms_mm"):
        assert metrics[name] == pytest.approx(0.05, abs=1e-4)
    assert metrics["sphere_ball_radius_error_mm"] == pytest.approx(0.05, abs=1e-3)
    assert metrics["sphere_ball_rms_mm"] < 1e-3 and metrics["plane_wall_rms_mm"] < 1e-3


def test_noise_along_the_ray_is_predicted_and_standardised(truth, perfect, rays, rng):
    """Points with the noise that they predict have z of unit spread, and an RMS as predicted, obliquely seen parts included."""
    metrics = measured(perfect + SIGMA * rng.standard_normal((*truth.lit.shape, 1)) * rays, truth)
    margin = 5 / np.sqrt(2 * truth.lit.sum())  # five standard deviations of a sample's standard deviation
    assert metrics["z_std"] == pytest.approx(1, abs=margin)
    assert metrics["z_robust_std"] == pytest.approx(1, abs=2 * margin)  # a median is noisier
    assert metrics["surface_rms_mm"] == pytest.approx(metrics["predicted_rms_mm"], rel=margin)
    assert metrics["predicted_rms_mm"] < SIGMA  # the error is measured across the surface, the noise lies along the ray


def test_gross_errors_are_counted_and_kept_out_of_the_noise(truth, perfect, rays, rng):
    spoilt = np.zeros(truth.lit.shape, bool)
    spoilt.flat[rng.choice(np.flatnonzero(truth.lit), 200, replace=False)] = True
    metrics = measured(perfect + np.where(spoilt, 20.0, 0.01)[..., None] * rays, truth)
    assert metrics["gross_error_fraction"] == pytest.approx(200 / truth.lit.sum())
    assert metrics["surface_rms_without_gross_mm"] < 0.0101
    assert metrics["surface_rms_mm"] > 0.5
    assert metrics["surface_median_abs_mm"] < 0.0101
    assert metrics["surface_bias_mm"] < 0  # farther from the camera is inside


def test_missing_pixels_lower_the_coverage_and_points_in_the_shadow_are_false(truth, perfect):
    points = perfect.copy()
    points[:128] = np.nan
    deep = np.argwhere(cv2.erode(np.uint8(~truth.lit), np.ones((9, 9))) > 0)[:40]  # 9 px reach farther than 3 px all around
    points[tuple(deep.T)] = truth.points[tuple(deep.T)]
    metrics = measured(points, truth)
    assert metrics["coverage"] == pytest.approx(truth.lit[128:].sum() / truth.lit.sum())
    assert metrics["false_points"] == 40
    assert metrics["points"] == truth.lit[128:].sum() + 40
    assert metrics["gross_error_fraction"] == 0, "they are where the surface is"


def test_wrong_points_where_nothing_is_lit_are_gross(truth, perfect, rays):
    """All points of the shadow put 20 mm behind the surface: none of them is compared, all of them are counted."""
    dark = ~truth.lit & (cv2.erode(np.uint8(truth.objects == 1), np.ones((3, 3))) > 0)  # on the wall, away from the ball
    assert dark.sum() > 100
    metrics = measured(np.where(dark[..., None], truth.points + 20 * rays, perfect), truth)
    assert metrics["gross_error_fraction"] == pytest.approx(dark.sum() / (dark.sum() + truth.lit.sum()))
    assert metrics["surface_rms_mm"] < 1e-4


def test_a_point_on_the_neighbours_surface_is_not_gross(truth, perfect, rays):
    """A pixel of the ball's outline that sees the wall is off by tens of mm, but on a true surface: no wrong fringe order."""
    wall = (truth.objects == 1) & truth.lit
    rim = (truth.objects == 0) & truth.lit & (cv2.dilate(np.uint8(wall), np.ones((3, 3))) > 0)
    to_wall = truth.points[wall][0, 2] / rays[..., 2]
    assert rim.sum() > 20
    metrics = measured(np.where(rim[..., None], to_wall[..., None] * rays, perfect), truth)
    assert metrics["gross_error_fraction"] == 0
    assert metrics["surface_rms_mm"] > 0.1 and metrics["surface_rms_without_gross_mm"] < 1e-4


def test_little_to_go_by_leaves_figures_unknown(truth, perfect, rays, session, tmp_path, capsys):
    """Three points, all of them gross: every name is there as ever, null where nothing can be said; the command says unknown."""
    points = np.full(perfect.shape, np.nan)
    few = np.argwhere(truth.lit & (truth.objects == 1))[:3]  # beside the image's border
    points[tuple(few.T)] = (perfect + 20 * rays)[tuple(few.T)]
    sigma = np.full(truth.lit.shape, np.nan, np.float32)
    np.savez(tmp_path / "points.npz", points=np.float32(points), sigma=sigma)
    edgy = replace(truth, objects=np.uint8(np.indices(truth.lit.shape).sum(axis=0) % 2))  # an edge everywhere: no interior
    metrics = surface_errors.measure(np.float32(points), surface_errors.compare(np.float32(points), sigma, edgy), edgy)
    assert metrics.keys() == measured(perfect, truth).keys()
    unknown = {name for name, value in metrics.items() if np.isnan(value)}
    assert {"surface_interior_rms_mm", "predicted_rms_mm", "z_std", "sphere_ball_rms_mm", "plane_wall_angle_error_deg"} <= unknown
    assert metrics["gross_error_fraction"] == 1

    assert main(["evaluate", f"surface={tmp_path}", f"truth={session.folder / 'truth'}"]) == 0
    text = (tmp_path / "evaluation" / "metrics.json").read_text(encoding="utf-8")
    assert json.loads(text)["z_std"] is None and "NaN" not in text
    assert "unknown" in describe(metrics) and "nan" not in capsys.readouterr().out


def test_the_interior_leaves_out_errors_at_the_edges(truth, perfect, rays):
    """Spoil the pixels within two pixels of the ball's outline; the interior doesn't notice, the rest does."""
    ball = truth.objects == 0
    grown = [np.roll(ball, (j, i), (0, 1)) for j in range(-2, 3) for i in range(-2, 3)]
    rim = np.any(grown, axis=0) & ~np.all(grown, axis=0)
    metrics = measured(perfect + 0.9 * rim[..., None] * rays, truth)
    assert metrics["surface_rms_mm"] > 0.05
    assert metrics["surface_interior_rms_mm"] < 1e-4
    interior = surface_errors.compare(np.float32(perfect), np.ones(truth.lit.shape, np.float32), truth).interior
    assert interior.sum() > 0.8 * truth.lit.sum()


@pytest.mark.parametrize(("column_px", "row_px"), [(0.05, None), (0.2, 0.02), (None, 0.005)])
def test_the_limit_is_what_noisy_projector_coordinates_do_to_the_surface(truth, session, rng, column_px, row_px):
    """Move the true coordinates by noise, find the points again without the code under test, and compare spreads.

    Of the two axes the coarser counts less. The projector stands beside the camera, so rows say little of the depth.
    """
    with np.load(session.folder / "truth" / "surface" / "cam1.npz") as archive:
        pixels = np.where(truth.lit[..., None], archive["projector"], np.nan)
    shape = truth.lit.shape
    noisy, sigma = [], []
    for axis, level in enumerate((column_px, row_px)):
        noisy.append(None if level is None else np.float32(pixels[..., axis] + level * rng.standard_normal(shape)))
        sigma.append(None if level is None else np.full(shape, level, np.float32))
    nothing = np.zeros(shape, np.float32)
    found = ProjectorMap(
        *noisy,
        *sigma,
        nothing,
        nothing,
        nothing,
        np.zeros(shape, np.uint8),
        truth.lit,
        DEFAULT_NOISE,
        {},
    )
    points = triangulate(found, truth.camera, truth.projector)
    limits = np.broadcast_to([np.inf if level is None else level for level in (column_px, row_px)], (*shape, 2))
    comparison = surface_errors.compare(points.points, points.sigma, replace(truth, limit_px=limits))
    z = comparison.error[comparison.compared] / comparison.limit[comparison.compared]
    assert np.std(z) == pytest.approx(1, abs=5 / np.sqrt(2 * z.size) + 0.005)  # float32 columns add half a percent at most


def test_a_cylinder_is_fitted_to_what_lies_on_it(rng):
    axis = np.array([0.6, 0.8, 0.0])
    across, up = np.array([-0.8, 0.6, 0.0]), np.array([0.0, 0.0, -1.0])
    angle, along = rng.uniform(-1, 1, 2000), rng.uniform(-40, 40, 2000)
    points = (
        np.array([3.0, 4.0, 660.0])
        + np.outer(along, axis)
        + 30.2 * (np.outer(np.cos(angle), up) + np.outer(np.sin(angle), across))
    )
    metrics = surface_errors.fit(Cylinder("tube", np.array([3.0, 4.0, 660.0]), axis, 30.0), points)
    assert metrics["cylinder_tube_radius_error_mm"] == pytest.approx(0.2, abs=1e-6)
    assert metrics["cylinder_tube_angle_error_deg"] < 1e-4


def test_the_command_writes_its_figures_and_a_picture(session, truth, perfect, tmp_path, capsys):
    surface = tmp_path / "surface"
    surface.mkdir()
    np.savez(
        surface / "points.npz",
        points=np.float32(perfect + 0.05 * truth.normals),
        sigma=np.full(truth.lit.shape, SIGMA, np.float32),
    )
    assert main(["evaluate", f"surface={surface}", f"truth={session.folder / 'truth'}"]) == 0
    metrics = json.loads((surface / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["surface_bias_mm"] == pytest.approx(0.05, abs=1e-4)
    assert (surface / "evaluation" / "error_map.png").read_bytes().startswith(b"\x89PNG")
    assert "RMS 0.050 mm" in capsys.readouterr().out


@pytest.mark.parametrize("out", ["surface", "truth", "."])
def test_the_command_never_writes_over_what_it_reads(out, session, perfect, truth, tmp_path, capsys):
    """Nor over a surface that is not its own, which has a metrics.json too."""
    (tmp_path / "surface").mkdir()
    sigma = np.full(truth.lit.shape, SIGMA, np.float32)
    np.savez(tmp_path / "surface" / "points.npz", points=np.float32(perfect), sigma=sigma)
    shutil.copytree(session.folder / "truth", tmp_path / "truth")
    for folder in (tmp_path, tmp_path / "surface", tmp_path / "truth"):
        for name in ("metrics.json", "error_map.png"):
            (folder / name).write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    assert main(["evaluate", f"surface={tmp_path / 'surface'}", f"truth={tmp_path / 'truth'}", f"out={tmp_path / out}"]) == 2
    assert capsys.readouterr().err.count("expected a folder apart from what is read") == 1
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "metrics.json").write_text("{}")
    elsewhere = f"out={tmp_path / 'elsewhere'}"
    assert main(["evaluate", f"surface={tmp_path / 'surface'}", f"truth={tmp_path / 'truth'}", elsewhere]) == 2
    assert "found other files" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "elsewhere")
    assert sorted(tmp_path.rglob("*")) == before


def test_mistakes_are_named(session, perfect, tmp_path):
    def complaint(truth_folder):
        with pytest.raises(InputError) as caught:
            surface_errors.read_truth(truth_folder)
        return str(caught.value)

    assert "scene.json: expected a file of the twin's ground truth, found none" in complaint(tmp_path)
    broken = tmp_path / "truth"
    shutil.copytree(session.folder / "truth", broken)
    np.savez(broken / "surface" / "cam1.npz", points=np.zeros((4, 5, 3), np.float32))
    assert "cam1.npz: normals: expected an array, found none" in complaint(broken)
    (broken / "surface" / "cam1.npz").write_bytes(b"PK but no archive")
    assert "expected an npz file of plain arrays" in complaint(broken)
    shutil.copy(session.folder / "truth" / "surface" / "cam1.npz", broken / "surface")
    scene = json.loads((broken / "scene.json").read_text(encoding="utf-8"))
    ball = scene["shapes"][0]
    for shape in (3, "ball", {}, ball | {"kind": "cube"}, ball | {"radius": "big"}, ball | {"centre": [1, 2]}):
        (broken / "scene.json").write_text(json.dumps(scene | {"shapes": [shape]}), encoding="utf-8")
        assert "scene.json: expected name, things and shapes" in complaint(broken)
    (broken / "scene.json").write_text("{", encoding="utf-8")
    assert "scene.json: expected JSON" in complaint(broken)


def test_sizes_must_match_and_something_must_be_seen(truth, perfect):
    sigma = np.ones(truth.lit.shape, np.float32)
    with pytest.raises(InputError, match="expected 320x256 as the truth has, found 320x100"):
        surface_errors.compare(np.float32(perfect[:100]), sigma[:100], truth)
    with pytest.raises(InputError, match="found none"):
        surface_errors.compare(np.full(perfect.shape, np.nan, np.float32), sigma, truth)


def test_a_shape_that_the_points_do_not_determine_is_unknown(rng):
    """Of a sphere so large that its piece is a plane within the noise, nothing is said; the evaluation goes on."""
    points = np.column_stack([rng.uniform(-10, 10, (500, 2)), rng.normal(650, 0.05, 500)])
    found = surface_errors.fit(Sphere("planet", np.array([0.0, 0.0, 1e6]), 1e6), points)
    assert len(found) == 3 and np.isnan(list(found.values())).all()
