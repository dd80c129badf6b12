"""Cleaning and meshing, on a hill in front of a wall whose edge pixels really see both."""

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation, gaussian_filter

from recon.errors import InputError
from recon.files import meshes
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.structured_light import surface_mesh
from recon.structured_light.triangulate import PointMap, triangulate
from tests.recon.fringe_scenes import projector_map

PITCH = 12.0  # projector px
WALL = 690.0  # mm
MIDDLE, AXES = np.array([0.0, 0.0, WALL]), np.array([85.0, 65.0, 55.0])  # of the hill, an ellipsoid cut by the wall, mm
CAMERA = Camera((640, 512), np.array([[1660.0, 0, 309], [0, 1665, 261], [0, 0, 1]]), np.zeros(5))
PROJECTOR_POSE = rigid.from_rotation_vector(np.deg2rad([5.214, -12.430, -2.472]), [148.861, -68.650, 14.818])
PROJECTOR = Camera((1280, 800), np.array([[1921.0, 0, 614], [0, 1927, 772], [0, 0, 1]]), np.zeros(5), PROJECTOR_POSE)


@dataclass(frozen=True)
class View:
    """What is at each pixel's centre."""

    points: np.ndarray  # (h, w, 3)
    columns: np.ndarray  # (h, w), projector px
    light: np.ndarray  # (h, w), 0 in the projector's shadow
    on_hill: np.ndarray  # (h, w)


@dataclass(frozen=True)
class Scene:
    """A triangulated view and its truth."""

    raw: PointMap
    modulation: np.ndarray
    truth: View


def first_hit(origin, directions):
    """Distance along rays to the hill or the wall, and which it is."""
    o, d = (origin - MIDDLE) / AXES, directions / AXES
    a, b, c = (d**2).sum(-1), (d * o).sum(-1), o @ o - 1
    hill = np.where(b * b > a * c, (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a, np.inf)
    wall = (WALL - origin[2]) / directions[..., 2]
    return np.where(hill < wall, hill, wall), hill < wall


def look(pixels) -> View:
    distance, on_hill = first_hit(np.zeros(3), CAMERA.rays(pixels))
    points = CAMERA.rays(pixels) * distance[..., None]
    normals = np.where(on_hill[..., None], (points - MIDDLE) / AXES**2, (0.0, 0.0, -1.0))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    to_light = PROJECTOR.centre - points
    length = np.linalg.norm(to_light, axis=-1)
    to_light /= length[..., None]
    lit = first_hit(PROJECTOR.centre, -to_light)[0] > length - 0.01
    image = PROJECTOR.project(points)
    lit &= ((image > 0) & (image < (1279, 799))).all(axis=-1)
    return View(points, image[..., 0], np.clip((normals * to_light).sum(-1), 0, 1) * lit, on_hill)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Fringes averaged over 3x3 points a pixel and a lens blur of 0.5 px, with noise of 2 DN in 8 steps."""
    grid = CAMERA.pixel_grid()
    fringe = np.zeros(grid.shape[:2], complex)
    for offset in np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2) / 3:
        seen = look(grid + offset)
        fringe += seen.light * np.exp(2j * np.pi * seen.columns / PITCH) / 9
    fringe = gaussian_filter(fringe.real, 0.5) + 1j * gaussian_filter(fringe.imag, 0.5)
    truth, modulation = look(grid), 100 * np.abs(fringe)
    sigma = np.sqrt(2 / 8) * 2 / np.maximum(modulation, 1e-3)
    turns = (np.angle(fringe) + np.random.default_rng(0).normal(size=sigma.shape) * sigma) / (2 * np.pi)
    columns = PITCH * (turns + np.round(truth.columns / PITCH - turns))
    dark = modulation < 4
    columns[dark] = sigma[dark] = np.nan
    return Scene(
        triangulate(projector_map(columns, sigma_columns=PITCH / (2 * np.pi) * sigma), CAMERA, PROJECTOR), modulation, truth
    )


def off(points: PointMap, truth: View) -> np.ndarray:
    """Points more than 1 mm from the truth."""
    return np.linalg.norm(points.points - truth.points, axis=-1) > 1


def known(points: PointMap) -> np.ndarray:
    return np.isfinite(points.points[..., 0])


def test_mixed_pixels_go_and_skin_stays(scene):
    """At most 5 in 10 000 points are off by a millimetre, an eighth of those before; 97 % of what both devices see stays."""
    cleaned = surface_mesh.clean(scene.raw, CAMERA, scene.modulation)
    before, after = (
        off(scene.raw, scene.truth).sum() / known(scene.raw).sum(),
        off(cleaned, scene.truth).sum() / known(cleaned).sum(),
    )
    seen = scene.truth.light > 0
    assert before > 8 * after and after < 5e-4
    assert (known(cleaned) & seen).sum() > 0.97 * seen.sum()
    hill = seen & scene.truth.on_hill
    assert (known(cleaned) & hill).sum() > 0.97 * hill.sum()


def test_a_pixel_between_two_surfaces_is_torn_from_both():
    """A wall 40 mm behind another, with a column of pixels in between that no modulation gives away: it goes, the walls stay."""
    camera = Camera((60, 40), np.array([[1660.0, 0, 29.5], [0, 1660, 19.5], [0, 0, 1]]), np.zeros(5))
    rays = camera.rays(camera.pixel_grid())
    depth = np.where(np.arange(60) < 30, 650.0, 690.0)
    depth[30] = 672
    points = (rays * (depth / rays[..., 2])[..., None]).astype(np.float32)
    cleaned = surface_mesh.clean(PointMap(points, np.full((40, 60), 0.02, np.float32)), camera)
    inside = known(cleaned)[2:-2]  # at the image's border there are too few pairs of neighbours to tell
    assert not inside[:, 30].any() and inside[:, :29].all() and inside[:, 32:].all()


def test_a_steep_slope_is_no_tear():
    """A wall seen at 80 deg from its normal: six sampling steps a pixel, all alike."""
    camera = Camera((60, 40), np.array([[1660.0, 0, 29.5], [0, 1660, 19.5], [0, 0, 1]]), np.zeros(5))
    rays, normal = camera.rays(camera.pixel_grid()), np.array([np.sin(np.deg2rad(80)), 0, -np.cos(np.deg2rad(80))])
    points = (rays * (normal[2] * 660 / (rays @ normal))[..., None]).astype(np.float32)
    assert known(surface_mesh.clean(PointMap(points, np.full((40, 60), 0.02, np.float32)), camera)).all()


def test_a_lone_outlier_goes_and_its_neighbours_stay(scene):
    points = scene.raw.points.copy()
    points[200, 320] *= 1.004  # 2.5 mm too far along its ray
    cleaned = surface_mesh.clean(PointMap(points, scene.raw.sigma), CAMERA, scene.modulation)
    assert not known(cleaned)[200, 320]
    assert known(cleaned)[198:203, 318:323].sum() == 24


def test_small_islands_and_weak_points_go(scene):
    points, sigma = scene.raw.points.copy(), scene.raw.sigma.copy()
    ring = np.zeros(sigma.shape, bool)
    ring[300:320, 300:320] = True
    points[binary_dilation(ring, iterations=2) & ~ring] = np.nan  # leaves an island of 400 px, whose edges are kept
    sigma[100:110, 300:310] = 5.0
    limits = surface_mesh.Limits(min_island_px=401)
    cleaned = surface_mesh.clean(PointMap(points, sigma), CAMERA, None, limits)
    assert not known(cleaned)[ring].any() and not known(cleaned)[100:110, 300:310].any()
    assert known(surface_mesh.clean(PointMap(points, sigma), CAMERA, None, surface_mesh.Limits(min_island_px=300)))[ring].all()


def test_cleaning_leaves_its_input_alone(scene):
    points, sigma = scene.raw.points.copy(), scene.raw.sigma.copy()
    surface_mesh.clean(scene.raw, CAMERA, scene.modulation)
    assert np.array_equal(points, scene.raw.points, equal_nan=True) and np.array_equal(sigma, scene.raw.sigma, equal_nan=True)


def test_the_mesh_faces_the_camera_and_does_not_bridge_steps(scene):
    cleaned = surface_mesh.clean(scene.raw, CAMERA, scene.modulation)
    mesh = surface_mesh.mesh(cleaned, CAMERA)
    towards = (mesh.triangles.mean(axis=1) * mesh.face_normals).sum(axis=1)
    assert (towards < 0).all() and ((mesh.vertices * mesh.vertex_normals).sum(axis=1) < 0).mean() > 0.999
    distance = np.linalg.norm(mesh.vertices, axis=1)
    steps = np.abs(np.diff(distance[mesh.edges_unique], axis=1))
    assert steps.max() < 1.5 * 12 * 690 / 1660 + 5, "1.5 times the steepest slope along a diagonal, and noise"
    assert len(mesh.vertices) > 0.999 * known(cleaned).sum()


def test_a_full_grid_has_two_triangles_a_square():
    """A flat wall, all pixels known: the mesh is whole, its normals and its area are the wall's."""
    camera = Camera((40, 30), np.array([[100.0, 0, 19.5], [0, 100, 14.5], [0, 0, 1]]), np.zeros(5))
    rays = camera.rays(camera.pixel_grid())
    points = (rays * (500 / rays[..., 2])[..., None]).astype(np.float32)
    mesh = surface_mesh.mesh(PointMap(points, np.full((30, 40), 0.01, np.float32)), camera)
    assert len(mesh.faces) == 2 * 39 * 29 and len(mesh.vertices) == 1200
    assert np.allclose(mesh.vertex_normals, (0, 0, -1), atol=1e-5) and np.isclose(mesh.area, 39 * 29 * 25, rtol=1e-5)
    with_hole = points.copy()
    with_hole[10, 10] = np.nan
    mesh = surface_mesh.mesh(PointMap(with_hole, np.full((30, 40), 0.01, np.float32)), camera)
    assert len(mesh.faces) == 2 * 39 * 29 - 4, (
        "each of the four squares about a missing point keeps the triangle that can do without"
    )


@pytest.mark.parametrize(
    "limits",
    [{"max_sigma": -1.0}, {"max_slope": np.nan}, {"min_modulation": 1.1}, {"min_island_px": 0}, {"min_tear": 0.0}],
    ids=str,
)
def test_limits_that_nothing_or_all_would_pass_are_refused(limits):
    (name,) = limits
    with pytest.raises(InputError, match=f"^{name}: expected a (whole )?number "):
        surface_mesh.Limits(**limits)


def test_a_slope_that_is_no_number_is_refused():
    """A comparison with it would tear every edge, and leave an empty mesh."""
    camera = Camera((8, 8), np.array([[100.0, 0, 4], [0, 100, 4], [0, 0, 1]]), np.zeros(0))
    flat = PointMap(np.float32(500 * camera.rays(camera.pixel_grid())), np.full((8, 8), 0.01, np.float32))
    assert len(surface_mesh.mesh(flat, camera, np.inf).faces) == 2 * 7 * 7
    with pytest.raises(InputError, match=r"^mesh_surface: max_slope: expected a number above 0, found nan$"):
        surface_mesh.mesh(flat, camera, np.nan)


def test_files_hold_the_mesh(scene, tmp_path):
    """PLY in mm with normals and sigma; GLB in metres, y up and towards the viewer, as glTF has it."""
    mesh = surface_mesh.mesh(surface_mesh.clean(scene.raw, CAMERA, scene.modulation), CAMERA)
    meshes.write_ply(tmp_path / "a.ply", mesh)
    meshes.write_glb(tmp_path / "a.glb", mesh)
    ply = trimesh.load(tmp_path / "a.ply", process=False)
    data = ply.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(ply.faces, mesh.faces) and np.abs(ply.vertices - mesh.vertices).max() == 0
    assert np.abs(ply.vertex_normals - mesh.vertex_normals).max() < 1e-6
    assert np.array_equal(data["sigma_mm"].ravel(), mesh.vertex_attributes["sigma_mm"])
    glb = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    assert np.abs(glb.vertices * (1000, -1000, -1000) - mesh.vertices).max() < 1e-3
    assert np.array_equal(glb.faces, mesh.faces)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.glb", "a.ply"]
