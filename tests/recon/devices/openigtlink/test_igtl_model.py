import struct

import numpy as np
import pytest

from recon.devices.openigtlink import igtl_model
from recon.devices.openigtlink.igtl_model import Model
from recon.errors import InputError


def polydata(points: np.ndarray, polygons: list[list[int]], strips: list[list[int]], attributes: bytes = b"") -> memoryview:
    """A body by the specification: lines and vertices too, which are passed over."""
    vertices, lines = [[0]], [[0, 1]]
    cells = [b"".join(struct.pack(f">{len(c) + 1}I", len(c), *c) for c in each) for each in (vertices, lines, polygons, strips)]
    counts = [n for each, data in zip((vertices, lines, polygons, strips), cells, strict=True) for n in (len(each), len(data))]
    head = struct.pack(">10I", len(points), *counts, bool(attributes))
    return memoryview(head + points.astype(">f4").tobytes() + b"".join(cells) + attributes)


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 2, 0]], float)


def area(model: Model) -> float:
    a, b, c = (model.points[model.triangles[:, k]] for k in range(3))
    return float(np.cross(b - a, c - a)[:, 2].sum() / 2)


def test_polygons_become_triangles_that_face_the_same_way():
    """A square, counter-clockwise: its area is 1, with its sign."""
    found = igtl_model.read(polydata(SQUARE, [[0, 1, 2, 3]], []))
    assert found.triangles.tolist() == [[0, 1, 2], [0, 2, 3]] and area(found) == pytest.approx(1)


def test_strips_become_triangles_that_face_the_same_way():
    found = igtl_model.read(polydata(SQUARE, [], [[0, 1, 3, 2]]))
    assert len(found.triangles) == 2 and area(found) == pytest.approx(1)


def test_attributes_are_passed_over():
    attributes = struct.pack(">BBI", 0, 1, 5) + b"attr\0\0" + bytes(20)
    assert len(igtl_model.read(polydata(SQUARE, [[0, 1, 2]], [], attributes)).triangles) == 1


def test_points_alone_are_a_model_without_triangles():
    assert igtl_model.read(polydata(SQUARE, [[0, 1]], [])).triangles.shape == (0, 3)


@pytest.mark.parametrize("polygons", [[[0, 1, 5]], [[0, 1, 2, 9]], [[0, 1, 2**32 - 1]]])
def test_corners_that_are_none_of_the_points_are_refused(polygons):
    with pytest.raises(InputError, match="corners among 5 points"):
        igtl_model.read(polydata(SQUARE, polygons, []))


@pytest.mark.parametrize("numbers", [(9, 0, 1, 2), (0, 1, 2, 3), (2**32 - 1, 0, 1, 2)])
def test_cells_that_run_over_are_refused(numbers):
    head = struct.pack(">10I", 5, 0, 0, 0, 0, 1, 16, 0, 0, 0)
    with pytest.raises(InputError, match="polygons"):
        igtl_model.read(memoryview(head + SQUARE.astype(">f4").tobytes() + struct.pack(">4I", *numbers)))


def test_sixteen_gigabytes_of_polygons_are_refused_by_their_sizes():
    with pytest.raises(InputError, match="expected a model of"):
        igtl_model.read(memoryview(struct.pack(">10I", 2**32 - 1, 0, 0, 0, 0, 2**30, 2**32 - 4, 0, 0, 0)))


def test_a_model_with_a_wrong_corner_is_not_written():
    with pytest.raises(InputError, match="corners among"):
        igtl_model.write(Model(SQUARE, np.array([[0, 1, 5]])))
