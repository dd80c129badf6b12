"""Do the wires of the scene stand as the phantom's definition has them?"""

import numpy as np
import pytest

from recon.errors import InputError
from recon.probe_calibration import plus_phantom
from scenes.kinds import n_wires


def test_the_wires_are_the_phantoms_moved_and_turned():
    """Distances of all ends are those of the definition, the first row is the upper one, the middle is where asked for."""
    scene = n_wires.build(n_wires.Config(turn_deg=30.0))
    phantom = plus_phantom.FCAL.wires
    ends = np.concatenate([
        shape.point + np.outer([-0.5, 0.5], shape.axis) * np.linalg.norm(np.subtract(*wire))
        for shape, wire in zip(scene.shapes, phantom.ends.reshape(-1, 2, 3), strict=True)
    ])  # fmt: skip
    of_definition = phantom.ends.reshape(-1, 3)
    for points in (ends, of_definition):
        points -= points.mean(axis=0)
    assert np.linalg.norm(ends[:, None] - ends, axis=-1) == pytest.approx(
        np.linalg.norm(of_definition[:, None] - of_definition, axis=-1), abs=1e-9
    )
    assert np.linalg.det(np.linalg.lstsq(of_definition, ends)[0]) == pytest.approx(1), "not mirrored"
    assert ends[0, 2] < ends[-1, 2], "nearer to the cameras"
    middles = np.array([shape.point for shape in scene.shapes])
    assert middles.mean(axis=0) == pytest.approx(n_wires.Config().middle_mm)


def test_wires_of_a_file_are_refused_as_by_calibrate_probe(tmp_path):
    (tmp_path / "none.xml").write_text("<PlusConfiguration/>", encoding="utf-8")
    with pytest.raises(InputError, match="PhantomDefinition: expected patterns of type NWire, found none"):
        n_wires.build(n_wires.Config(wires=tmp_path / "none.xml"))
