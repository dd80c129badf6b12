import numpy as np
import pytest

from twin.displacement import (
    NOWHERE,
    Flow,
    carried_along,
    carried_back,
    cofactors,
    displacement,
    led_through,
    led_to,
    moved_to,
    rested_at,
    volume_ratio,
)

FIRST, STEP, COUNTS = np.array([-30.0, -20.0, 640.0]), 2.5, (25, 17, 21)


def grid():
    axes = [start + STEP * np.arange(count) for start, count in zip(FIRST, COUNTS, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def dented(depth_mm=3.0, width_mm=8.0):
    """A dent of a Gaussian's form; strains reach 0.86 depth over width: 0.32."""
    places = grid()
    distance = np.linalg.norm(places - [0, 0, 665.0], axis=-1, keepdims=True)
    return displacement(FIRST, STEP, (depth_mm * np.exp(-((distance / width_mm) ** 2)) * [0.3, -0.2, 1.0]).astype(np.float32))


def test_an_affine_field_is_exact_within_its_grid(rng):
    slopes = np.array([[0.03, 0.01, 0.0], [0.0, -0.02, 0.02], [0.01, 0.0, 0.04]])
    field = displacement(FIRST, STEP, ((grid() - FIRST) @ slopes.T).astype(np.float32))
    points = FIRST + rng.uniform(0, 1, (500, 3)) * STEP * (np.array(COUNTS) - 1)
    np.testing.assert_allclose(moved_to(field, points), points + (points - FIRST) @ slopes.T, atol=1e-5)
    np.testing.assert_allclose(volume_ratio(field), np.linalg.det(np.eye(3) + slopes), atol=1e-5)


def test_points_come_back_to_where_they_rested(rng):
    points = rng.uniform([-25, -15, 645], [25, 15, 685], (2000, 3))
    np.testing.assert_allclose(rested_at(dented(), moved_to(dented(), points)), points, atol=1e-9)


def test_compiled_code_carries_points_alike(rng):
    points, field = rng.uniform([-25, -15, 645], [25, 15, 685], (2000, 3)), dented()
    grid = field.first, field.per_mm
    along = np.array([carried_along(field.moved, *grid, *point) for point in points])
    back = np.array([carried_back(field.moved, field.back, *grid, *point) for point in points])
    np.testing.assert_allclose(along, moved_to(field, points), atol=1e-12)
    np.testing.assert_allclose(back, rested_at(field, points), atol=0.01)


def test_small_steps_and_areas_become_those_between_points_close_by(rng):
    """Within a cell the field bends little over 1e-4 mm; a step that crosses into the next one is left out."""
    field, h = dented(), 1e-4
    places = FIRST + STEP * (rng.integers(2, 12, (100, 3)) + rng.uniform(0.1, 0.9, (100, 3)))
    for place in places:
        *rows, volume = cofactors(field.moved, field.first, field.per_mm, *place)
        steps = (moved_to(field, place + h * np.eye(3)) - moved_to(field, place)) / h  # a row for a step along each axis
        np.testing.assert_allclose(np.array(rows) @ steps.T / volume, np.eye(3), atol=2e-3)
        assert volume == pytest.approx(np.linalg.det(steps), abs=2e-3)
        np.testing.assert_allclose(rows[0], np.cross(steps[1], steps[2]), atol=2e-3)


def test_beyond_its_grid_a_field_is_that_of_the_border():
    field = displacement(FIRST, STEP, np.full((*COUNTS, 3), [1.0, 2.0, -3.0], np.float32))
    far = np.array([[-500.0, 0.0, 660.0], [0.0, 90.0, 2000.0]])
    np.testing.assert_allclose(moved_to(field, far), far + np.array([1.0, 2.0, -3.0]), atol=1e-6)
    np.testing.assert_allclose(rested_at(field, far), far - np.array([1.0, 2.0, -3.0]), atol=1e-6)


def test_a_flow_without_divergence_keeps_volumes_where_its_field_does_to_first_order_alone():
    x, y, z = np.moveaxis(grid() - [0, 0, 665.0], -1, 0)
    hill = 2.0 * np.exp(-(x**2 + z**2) / 100 - y**2 / 200)
    swirl = np.stack([z * hill / 8, 0 * y, -x * hill / 8], axis=-1)  # the curl of a potential along y, but for what y does
    field = displacement(FIRST, STEP, swirl.astype(np.float32))
    inner = np.s_[2:-2, 2:-2, 2:-2]
    led = led_through(Flow(FIRST, 1 / STEP, field.moved))
    plain, flowing = (np.abs(volume_ratio(one)[inner] - 1).max() for one in (field, led))
    assert plain > 0.02
    assert flowing < 0.2 * plain


def test_some_points_are_led_as_by_the_whole_field(rng):
    points, flow = rng.uniform([-40, -15, 635], [25, 15, 685], (500, 3)), Flow(FIRST, 1 / STEP, dented().moved)
    np.testing.assert_allclose(led_to(flow, points), moved_to(led_through(flow), points), atol=1e-6)


def test_nothing_moves_without_a_field(rng):
    points = rng.uniform(-10, 10, (20, 3))
    assert (moved_to(NOWHERE, points) == points).all()
    assert (rested_at(NOWHERE, points) == points).all()
