"""The printed board against its design."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from recon.geometry import rigid
from scenes.kinds import board


def fronts(config):
    """Front triangles of ground and discs, in the board's frame: (m, 3, 3) mm each."""
    board_from_world = rigid.invert(board.world_from_board(config))
    result = []
    for thing in board.build(config).things:
        vertices = rigid.apply(board_from_world, thing.mesh.vertices)
        front = thing.mesh.faces < len(vertices) // 2
        result.append(vertices[thing.mesh.faces[front.all(axis=1)]])
    return result


def area(triangles):
    return np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1).sum() / 2


def test_the_discs_have_the_area_of_circles_and_the_ground_the_rest():
    config = board.Config()
    ground, discs = fronts(config)
    polygon = board.SIDES / 2 * np.sin(2 * np.pi / board.SIDES) * (config.diameter_mm / 2) ** 2
    assert area(discs) == pytest.approx(44 * polygon)
    assert polygon == pytest.approx(np.pi * config.diameter_mm**2 / 4, rel=2e-4)
    assert area(ground) + area(discs) == pytest.approx(129 * 174)


@settings(max_examples=10, deadline=None)
@given(
    columns=st.integers(2, 5),
    rows=st.integers(2, 7),
    spacing=st.floats(10, 20),
    fill=st.floats(0.2, 0.9),
    turn=st.tuples(*[st.floats(-60, 60)] * 3),
    print_error=st.floats(0, 0.1),
)
def test_any_board_is_closed_and_its_circles_are_where_it_says(columns, rows, spacing, fill, turn, print_error):
    config = board.Config(
        columns=columns,
        rows=rows,
        spacing_mm=spacing,
        diameter_mm=fill * (np.sqrt(2) * spacing - 8 * print_error),
        margin_mm=spacing,
        rotation_deg=turn,
        print_error_mm=print_error,
    )
    ground, discs = (thing.mesh for thing in board.build(config).things)
    for mesh in (ground, discs):
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert discs.body_count == rows * columns
    distance = np.linalg.norm(discs.vertices[:, None] - board.circle_centres(config), axis=2).min(axis=1)
    front = len(discs.vertices) // 2
    assert distance[:front].max() == pytest.approx(config.diameter_mm / 2, abs=1e-9)


def largest_discs(print_error: float) -> board.Config:
    """The board with the largest discs that are accepted, to 0.01 mm."""
    for diameter in np.arange(21.3, 10, -0.01):
        try:
            return board.Config(columns=3, rows=5, spacing_mm=15, margin_mm=15, diameter_mm=diameter, print_error_mm=print_error)
        except ValidationError:
            continue
    raise AssertionError("no diameter is accepted")


@pytest.mark.parametrize("print_error", [0, 0.3])
def test_discs_as_large_as_allowed_stay_apart(monkeypatch, print_error):
    """Every other row is moved towards the next, by the largest errors in x and in y; half a side of the outline is left."""
    config = largest_discs(print_error)
    error = 2 * board.MAX_ERRORS * print_error * (np.arange(15) // 3 % 2)[:, None]
    monkeypatch.setattr(board, "_printed", lambda config: board.design(config).points()[:, :2] + error)
    ground, discs = (thing.mesh for thing in board.build(config).things)
    assert ground.is_watertight and discs.is_watertight and discs.body_count == 15
    nearest = np.sqrt(2) * (15 - 2 * board.MAX_ERRORS * print_error)
    assert nearest - config.diameter_mm > config.diameter_mm / 2 * np.sin(np.pi / board.SIDES)


def test_the_printed_centres_scatter_as_asked():
    config = board.Config(rotation_deg=(0, 0, 0), print_error_mm=0.02)
    designed = rigid.apply(board.world_from_board(config), board.design(config).points())
    error = (board.circle_centres(config) - designed)[:, :2]
    assert error.std() == pytest.approx(0.02, rel=3 / np.sqrt(2 * error.size))  # three sigma of 88 draws
    np.testing.assert_array_equal(board.circle_centres(config), board.circle_centres(config))
    assert not np.array_equal(board.circle_centres(config), board.circle_centres(config.model_copy(update={"seed": 2})))


def test_the_warp_is_a_saddle_of_the_asked_height():
    config = board.Config(warp_mm=0.5)
    ground, discs = fronts(config)
    z = np.concatenate([ground, discs])[..., 2]
    assert (z.min(), z.max()) == (pytest.approx(-0.5, abs=0.01), pytest.approx(0.5, abs=0.01))
    centres = rigid.apply(rigid.invert(board.world_from_board(config)), board.circle_centres(config))
    mesh = np.concatenate([ground, discs]).reshape(-1, 3)
    for centre in centres[::7]:  # each disc has a vertex at its centre
        assert np.abs(mesh - centre).max(axis=1).min() < 1e-9


def test_a_bow_is_an_arch_a_twist_and_an_arch():
    """In the middle of a long edge, of a short one, and in two corners."""
    config = board.Config(bow_mm=(0.4, -0.2, 0.1), warp_mm=0.05, margin_mm=12)
    half = np.array([7, 10]) * 15 / 2 + 12
    middle = np.array([7, 10]) * 15 / 2
    heights = board._heights(config, middle + half * np.array([(1, 0), (0, 1), (1, 1), (1, -1)]))
    assert heights == pytest.approx([0.45, 0.05, 0.3, 0.7])
    assert board.printed(config).bow == pytest.approx([0.45, -0.2, 0.05])


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"diameter_mm": 0.4, "spread_mm": -0.5}, "spread_mm"),
        ({"margin_mm": 4.6, "spread_mm": 0.5}, "margin_mm"),
        ({"margin_mm": 4.6, "stretch": (0.005, 0, 0)}, "margin_mm"),
        ({"diameter_mm": 20.9, "spread_mm": 0.4}, "diameter_mm"),
    ],
)
def test_prints_that_leave_no_discs_or_leave_the_board_are_refused(fields, named):
    with pytest.raises(ValidationError, match=named):
        board.Config(**fields)


def test_a_stretched_print_and_wide_discs():
    """Length over width is off by the asked share, right angles by the shear, and the design stays as it was."""
    config = board.Config(stretch=(3e-3, 2e-3, 1e-3), spread_mm=0.06)
    points, straight = board.printed_centres(config), board.design(config).points()
    along, across = (np.linalg.lstsq(straight - straight.mean(axis=0), points[:, k] - points[:, k].mean())[0] for k in (0, 1))
    assert along[0] - across[1] == pytest.approx(2e-3) and along[1] + across[0] == pytest.approx(1e-3)
    assert (along[0] + across[1]) / 2 == pytest.approx(1.003)
    assert board.printed(config).radius == pytest.approx(4.53) and board.design(config).diameter_mm == 9
    discs = board.things(config)[1].mesh
    front = discs.vertices[: len(discs.vertices) // 2]
    assert np.linalg.norm(front[:, None] - points, axis=2).min(axis=1).max() == pytest.approx(4.53, abs=1e-9)


def test_opencv_finds_the_circles_in_our_order():
    """The board drawn as camera 1 would see it; an independent reader of the asymmetric layout."""
    config = board.Config()
    centres = board.circle_centres(config)
    pixels = centres[:, :2] / centres[:, 2:] * 3320 + (618, 523)
    image = np.full((1024, 1280), 230, np.uint8)
    for u, v in np.rint(pixels * 16).astype(int):
        cv2.circle(image, (int(u), int(v)), 16 * 22, 20, -1, cv2.LINE_AA, 4)
    found, seen = cv2.findCirclesGrid(image, (config.columns, config.rows), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    np.testing.assert_allclose(seen.reshape(-1, 2), pixels, atol=0.5)
