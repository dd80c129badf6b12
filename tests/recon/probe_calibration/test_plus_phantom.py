"""Are N-wires read as PLUS's configurations define them, and broken definitions refused in one line?"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.errors import InputError
from recon.model.wire_phantom import FCAL_2
from recon.probe_calibration import plus_phantom
from tests.recon.files.mutations import damaged
from tests.recon.wire_rows import FCAL


def written(ends=FCAL.ends, transforms="", kind="NWire"):
    """A configuration of PLUS with these wires."""
    rows = "".join(
        f'<Pattern Type="{kind}">'
        + "".join(
            f'<Wire Name="{row}:{k}" EndPointFront="{" ".join(map(str, front))}" EndPointBack="{" ".join(map(str, back))}"/>'
            for k, (front, back) in enumerate(wires)
        )
        + "</Pattern>"
        for row, wires in enumerate(ends)
    )
    return (
        f"<PlusConfiguration><CoordinateDefinitions>{transforms}</CoordinateDefinitions>"
        f"<PhantomDefinition><Geometry>{rows}</Geometry></PhantomDefinition></PlusConfiguration>"
    )


def transform(of, to, matrix):
    return f'<Transform From="{of}" To="{to}" Matrix="{" ".join(map(str, np.ravel(matrix)))}"/>'


def read(tmp_path, text, reference="Reference"):
    path = tmp_path / "fcal.xml"
    path.write_text(text, encoding="utf-8")
    return plus_phantom.read(path, reference)


def test_wires_and_transforms_are_read(tmp_path):
    pose, matrix = np.eye(4), np.diag([0.08, 0.07, 0.075, 1])
    pose[:3, 3] = 1, 2, 3
    found = read(tmp_path, written(transforms=transform("Phantom", "Reference", pose) + transform("Image", "Probe", matrix)))
    assert found.wires.ends.tolist() == np.array(FCAL_2, float).tolist()
    assert found.wires.names[4] == "1:1"
    assert found.reference_from_phantom == pytest.approx(pose) and found.target_from_pixel == pytest.approx(matrix)
    inverse = read(tmp_path, written(transforms=transform("Reference", "Phantom", np.linalg.inv(pose))))
    assert inverse.reference_from_phantom == pytest.approx(pose)
    assert read(tmp_path, written(), "Tracker").reference_from_phantom is None


@pytest.mark.parametrize(("text", "said"), [
    ("<PlusConfiguration/>", "PhantomDefinition: expected patterns of type NWire, found none"),
    (written(kind="CoplanarParallelWires"), "found one of type CoplanarParallelWires"),
    (written().replace("EndPointBack", "EndPointRear"), "EndPointBack, three numbers in mm, found none"),
    (written(FCAL.ends[:, :2]), "Pattern 1: expected 3 wires: a side, the diagonal, the other side, found 2"),
    (written(FCAL.ends / 1000), "another unit?"),
    (written().replace("30.0 0.0 20.0", "30.0 0.0", 1), "EndPointFront: expected 3 finite numbers"),
    (written(transforms=transform("Phantom", "Reference", np.diag([1, 1, -1, 1]))), "PhantomToReference: expected a rigid"),
    (written(transforms=transform("Phantom", "Reference", np.zeros((4, 4)))), "an invertible matrix"),
    ("<!DOCTYPE a><a/>", "without a document type"),
])  # fmt: skip
def test_a_broken_definition_is_refused_in_one_line(text, said, tmp_path):
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert said in str(error.value) and str(tmp_path) in str(error.value) and "\n" not in str(error.value)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_definitions_are_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.xml"
    path.write_bytes(data.draw(damaged(written(transforms=transform("Phantom", "Reference", np.eye(4))).encode())))
    try:
        assert np.isfinite(plus_phantom.read(path, "Reference").wires.ends).all()
    except InputError as error:
        assert "\n" not in str(error)
