"""Settings that studies begin with, and trials that nobody ran."""

from pathlib import Path

import pytest
import yaml

from recon.model.patterns import Patterns
from scenes.board_poses import Config as Poses
from twin.studies.experiments import Settings

CONF = Path(__file__).resolve().parents[3] / "conf"


@pytest.fixture(scope="session")
def settings(rig, scanners) -> Settings:
    """The rig and the patterns of the paper, as in `conf/study.yaml`, and ten poses of the board."""
    content = {name: yaml.safe_load((CONF / f"{name}.yaml").read_text(encoding="utf-8")) for name in PLACES}
    patterns = {name: Patterns.model_validate(content[f"patterns/{name}"]) for name in ("paper_surface", "paper_calibration")}
    return Settings(
        rig=rig,
        patterns=patterns["paper_surface"],
        board_patterns=patterns["paper_calibration"],
        poses=Poses(count=10),
        ultrasound=scanners["water"],
        ranges=content["dataset"]["ranges"],
    )


PLACES = ("dataset", "patterns/paper_surface", "patterns/paper_calibration")
