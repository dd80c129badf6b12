"""A tip survives its file, and a bad file is refused in one line."""

import re
from dataclasses import replace

import numpy as np
import pytest

from recon.capture import tip_files
from recon.errors import InputError
from recon.model.tip import AXIS, DIMPLE, TIP, Tip

FOUND = np.array([0.5, -2.25, -150.125])


def covariance(count, rng):
    root = 1e-2 * rng.standard_normal((count, count))
    return root @ root.T


@pytest.fixture
def tip(rng, tmp_path) -> Tip:
    return Tip(
        FOUND,
        covariance(9, rng),
        np.array([0.0, 0.6, -0.8]),
        np.array([10.0, 20, 700]),
        0.06,
        198,
        tmp_path / "needle.stl",
        "needle",
    )


@pytest.fixture
def written(tip, tmp_path):
    tip_files.write(tmp_path / "tip.yaml", tip)
    return tmp_path / "tip.yaml"


def test_what_is_written_is_read(tip, written):
    back = tip_files.read(written)
    for name in ("tip_mm", "axis", "dimple_mm", "covariance"):
        np.testing.assert_allclose(getattr(back, name), getattr(tip, name), rtol=1e-12)
    assert (back.rms_mm, back.frames, back.model, back.body) == (0.06, 198, tip.model, "needle")
    assert back.parameters == (*TIP, *DIMPLE, *AXIS)
    np.testing.assert_allclose(back.covariance_of(AXIS), tip.covariance[6:, 6:])


def test_a_drawings_tip_has_neither_dimple_nor_frames(rng, tmp_path):
    tip_files.write(tmp_path / "tip.yaml", Tip(FOUND, covariance(3, rng)))
    back = tip_files.read(tmp_path / "tip.yaml")
    assert back.axis is None and back.dimple_mm is None and back.model is None and np.isnan(back.rms_mm) and back.frames == 0


def test_another_bodys_tip_is_refused_and_one_without_a_name_is_taken(tip, written):
    assert tip_files.read(written, "needle").body == "needle"
    with pytest.raises(InputError, match="body: expected the tip of stylus, found that of needle: another tool"):
        tip_files.read(written, "stylus")
    tip_files.write(written, replace(tip, body=""))
    assert "body" not in written.read_text() and tip_files.read(written, "stylus").body == ""


def test_the_models_path_holds_from_where_the_file_goes(tip, tmp_path):
    """The file is written elsewhere first, and the folder is moved with what lies beside it."""
    (tmp_path / "made").mkdir()
    tip_files.write(tmp_path / "made" / "tip.yaml", tip, tmp_path / "out")
    assert "model: ../needle.stl" in (tmp_path / "made" / "tip.yaml").read_text().replace('"', "")


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("sonotwin-tip/1", "sonotwin-tip/9", "schema: expected sonotwin-tip/1, found sonotwin-tip/9"),
        ("tip_mm:", "tips_mm:", "tip_mm: expected a matrix, found none"),
        ("body: needle", "body: 7", "body: expected a name of rig.bodies, found 7"),
        ("-2.25", ".Nan", "tip_mm: expected three finite numbers"),
        ("-0.8", "-0.9", "axis: expected a direction of length 1, found one of 1.08"),
        ("rms_mm: 0", "rms_mm: -0", "rms_mm: expected a number from 0 on"),
        ("frames: 198", "frames: many", "frames: expected a number from 0 on"),
        ("   - tip_x\n", "", "parameters: expected tip_x tip_y tip_z dimple_x"),
        ("axis:", "shaft:", "parameters: expected tip_x tip_y tip_z dimple_x dimple_y dimple_z, as of what the file holds"),
        ("covariance:", "variance:", "covariance: expected a matrix, found none"),
        ("%YAML", "\x00", "damaged"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(written, old, new, named):
    text = written.read_text()
    assert old in text
    written.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=r"tip\.yaml: ") as caught:
        tip_files.read(written)
    assert named in str(caught.value) and "\n" not in str(caught.value)


def test_other_files_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", K1=np.eye(3))
    for path in (tmp_path / "other.npz", tmp_path / "none.yaml"):
        with pytest.raises(InputError, match=re.escape(str(path))):
            tip_files.read(path)
