"""Figures come back from their file as they were, the unknown ones too."""

import json
import math

import pytest

from recon.errors import InputError
from recon.files import metrics


def test_figures_come_back(tmp_path):
    path = tmp_path / metrics.FILE
    metrics.write(path, {"points": 3, "surface_rms_mm": 0.1, "z_std": math.nan})
    found = metrics.read(path)
    assert list(found) == ["points", "surface_rms_mm", "z_std"]
    assert found["points"] == 3 and found["surface_rms_mm"] == 0.1 and math.isnan(found["z_std"])
    assert json.loads(path.read_text(encoding="utf-8"), parse_constant=pytest.fail)["z_std"] is None


@pytest.mark.parametrize("content", ["", "{", "[1]", "3"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "metrics.json").write_text(content)
    with pytest.raises(InputError, match=r"expected (figures by name|JSON)"):
        metrics.read(tmp_path / "metrics.json")


def test_people_read_unknown():
    assert metrics.shown(0.0314, ".3f", " mm") == "0.031 mm"
    assert metrics.shown(math.nan, ".3f", " mm") == "unknown"
