"""The rows of the tumours at full size."""

from pathlib import Path

import yaml

from twin.experiments import mass_accuracy
from twin.ultrasound.probe_path import SurfacePath

ROOT = Path(__file__).resolve().parents[3]


def test_the_path_is_that_of_the_configuration():
    fields = yaml.safe_load((ROOT / "conf" / "path" / "raster.yaml").read_text(encoding="utf-8"))
    assert SurfacePath(**fields) == mass_accuracy.PATH
