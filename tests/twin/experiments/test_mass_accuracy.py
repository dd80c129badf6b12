"""The rows of the tumours, at full size."""

from pathlib import Path

import pytest
import yaml

from recon.capture.surface_part import read_patterns
from tests.twin.experiments.asked import missed
from tests.twin.small_rigs import half
from twin.experiments import mass_accuracy
from twin.experiments.experiment_setup import Setup
from twin.ultrasound.probe_path import SurfacePath

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_tumours_are_found_as_large_as_they_are(rig):
    """All three, no others, within 0.5 mm and 8 %, under the skin by cameras of half the size; one of the two sweeps."""
    setup = Setup(half(rig), {path.stem: read_patterns(path) for path in (ROOT / "conf" / "patterns").glob("*.yaml")})
    assert not missed(mass_accuracy.tumours_found, mass_accuracy.tumours_found(setup, mass_accuracy.SEEDS[:1]))


def test_the_path_is_that_of_the_configuration():
    fields = yaml.safe_load((ROOT / "conf" / "path" / "raster.yaml").read_text(encoding="utf-8"))
    assert SurfacePath(**fields) == mass_accuracy.PATH
