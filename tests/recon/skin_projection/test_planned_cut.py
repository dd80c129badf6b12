"""Is a cut read as 3D Slicer has it, and laid on the skin under it?"""

import json

import numpy as np
import pytest

from recon.errors import InputError
from recon.skin_projection import planned_cut
from tests.recon.skin_projection.skin_shapes import DOME_MM, PLANE_MM, dome, plane

ARC = [[-20.0, 10.0, 665.0], [0.0, 14.0, 662.0], [20.0, 10.0, 665.0]]


def markups(folder, points=ARC, kind="Curve", system="LPS", **more):
    controls = [{"id": str(k), "position": point, "positionStatus": "defined"} for k, point in enumerate(points)]
    one = {"type": kind, "coordinateSystem": system, "coordinateUnits": "mm", "controlPoints": controls} | more
    path = folder / "cut.mrk.json"
    path.write_text(json.dumps({"@schema": "markups-schema-v1.0.3.json#", "markups": [one]}))
    return path


def test_a_curve_goes_through_its_control_points(tmp_path):
    (chain,) = planned_cut.read(markups(tmp_path))
    assert max(np.linalg.norm(chain - point, axis=1).min() for point in ARC) < 1e-9
    assert len(chain) > 20 and np.abs(np.diff(chain, n=2, axis=0)).max() < 0.2, "round at the middle one"


def test_a_line_is_straight_and_a_closed_curve_closes_smoothly(tmp_path):
    (line,) = planned_cut.read(markups(tmp_path, ARC[:2], "Line"))
    assert np.allclose(line, ARC[:2])
    square = [[x, y, 665.0] for x, y in ((10, 10), (-10, 10), (-10, -10), (10, -10))]
    (ring,) = planned_cut.read(markups(tmp_path, square, "ClosedCurve"))
    assert np.allclose(ring[0], ring[-1])
    around = np.hypot(*ring[:, :2].T)
    assert np.abs(around / (10 * np.sqrt(2)) - 1).max() < 0.1, "a spline through a square's corners is nearly its circle"


def test_ras_is_turned_into_the_world(tmp_path):
    mirrored = [[-x, -y, z] for x, y, z in ARC]
    (first,), (second,) = planned_cut.read(markups(tmp_path)), planned_cut.read(markups(tmp_path, mirrored, system="RAS"))
    assert np.allclose(first, second)


def test_a_cut_above_the_skin_is_laid_on_it(tmp_path):
    (chain,) = planned_cut.read(markups(tmp_path))
    curve = planned_cut.on_skin("cut0", chain, dome(step=0.5))
    assert curve.on_skin == 1
    assert np.abs(np.linalg.norm(curve.points - [0, 0, PLANE_MM + DOME_MM], axis=1) - DOME_MM).max() < 0.01
    assert 40 < curve.length_mm < 46
    seen = planned_cut.on_skin("cut0", chain, dome(step=0.5), [0.0, 0, 0])
    assert np.allclose(seen.points[:, :2] / seen.points[:, 2:], _even(chain), atol=1e-3), "along the eye's lines"


def _even(chain):
    from recon.skin_projection.skin_curve import evenly

    points = evenly(chain)
    return points[:, :2] / points[:, 2:]


def test_a_cut_that_touches_the_skin_has_a_normal(tmp_path):
    """Through a vertex of a plane, where there is no way from the cut to the skin."""
    skin, eye = plane(), [0.0, 0, 0]
    for seen_from in (None, eye):
        curve = planned_cut.on_skin("cut0", [[-10.0, 0, PLANE_MM], [10.0, 0, PLANE_MM]], skin, seen_from)
        assert curve.on_skin == 1 and curve.length_mm == pytest.approx(20) and np.allclose(curve.normals, [0, 0, -1])


def test_a_cut_that_nothing_lies_under_is_refused():
    with pytest.raises(InputError, match="cut0: expected skin under it, found none"):
        planned_cut.on_skin("cut0", np.add(ARC, [500.0, 0, 0]), dome())


@pytest.mark.parametrize(("change", "complaint"), [
    ({"points": ARC[:1]}, "markups.0.controlPoints: expected"),
    ({"points": [ARC[0], [-6e60, 0.0, 0.0]]}, r"markups.0.controlPoints.1.position.0: expected greater than or equal to -10000"),
    ({"points": [ARC[0], ARC[0]]}, "markups.0: expected control points in two places or more"),
    ({"kind": "ROI"}, "markups.0.type: expected"),
    ({"system": "XYZ"}, "markups.0.coordinateSystem: expected"),
    ({"coordinateUnits": "m"}, "markups.0.coordinateUnits: expected 'mm'"),
    ({"points": [[0.0, 0], [1.0, 1]]}, "position"),
])  # fmt: skip
def test_other_files_are_refused_in_one_line(tmp_path, change, complaint):
    path = markups(tmp_path, **change)
    with pytest.raises(InputError) as told:
        planned_cut.read(path)
    assert complaint in str(told.value) and str(path) in str(told.value) and "\n" not in str(told.value)
