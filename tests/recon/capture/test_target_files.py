"""A measured target survives its file, and a bad file is refused in one line."""

import re

import numpy as np
import pytest

from recon.capture import target_files
from recon.errors import InputError


@pytest.fixture
def measured(rig):
    update = {
        "c1_mm": 25.0123,
        "c2_aside_mm": -0.2,
        "c2_mm": 39.875,
        "outer_diameter_mm": 18.03,
        "curvature_per_m": (0.2, 0.0, -0.1),
    }
    return rig.target.model_copy(update=update)


@pytest.fixture
def written(measured, rng, tmp_path):
    root = 1e-3 * rng.standard_normal((7, 7))
    covariance = root @ root.T
    target_files.write(tmp_path / "target.yaml", measured, covariance)
    return tmp_path / "target.yaml", covariance


def test_what_is_written_is_read(measured, written, rig):
    path, covariance = written
    back = target_files.read(path, rig.target)
    assert back.model_copy(update={"covariance_mm2": None}) == measured
    np.testing.assert_allclose(back.covariance_mm2, covariance[:3, :3], rtol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("sonotwin-target/1", "sonotwin-target/9", "schema: expected sonotwin-target/1, found sonotwin-target/9"),
        ("c1_mm: 25", "c1: 25", "c1_mm: expected a length in mm, found none"),
        ("c1_mm: 25.0123", "c1_mm: long", "c1_mm: expected a length in mm, found something else"),
        ("c1_mm: 25.0123", "c1_mm: -25.0", "c1_mm: expected greater than 0, found -25.0"),
        ("c2_mm: 39.875", "c2_mm: .Nan", "c2_mm: expected"),
        ("outer_diameter_mm: 18.03", "outer_diameter_mm: 7.0", "inner_diameter_mm: expected less than outer_diameter_mm = 7"),
        ("curvature_per_m:", "curvature:", "curvature_per_m: expected a matrix, found none"),
        ("   - c1_mm\n", "", "parameters: expected c1_mm c2_aside_mm"),
        ("   - c1_mm\n", "   - c2_mm\n", "parameters: expected c1_mm c2_aside_mm"),
        ("covariance:", "variance:", "covariance: expected a matrix, found none"),
        ("%YAML", "\x00", "damaged"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(written, rig, old, new, named):
    path, _ = written
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=r"target\.yaml: ") as caught:
        target_files.read(path, rig.target)
    assert named in str(caught.value) and "\n" not in str(caught.value)


def test_other_files_are_refused(rig, tmp_path):
    np.savez(tmp_path / "other.npz", K1=np.eye(3))
    for path in (tmp_path / "other.npz", tmp_path / "none.yaml"):
        with pytest.raises(InputError, match=re.escape(str(path))):
            target_files.read(path, rig.target)
