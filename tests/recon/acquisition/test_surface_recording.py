"""Surfaces are recorded as the operator has it; what is wrong is said, and not kept unless told to."""

import numpy as np
import pytest

from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.pictures import hidden
from recon.acquisition.recording import open_recording
from recon.acquisition.surface_recording import SurfacePlan, record_surface
from recon.artwork.projected_images import images
from recon.capture.manifest import read_manifest
from recon.devices.pattern_player import Stage, Triggered
from recon.model.patterns import Fringes, GrayCode, Patterns
from tests.recon.acquisition import stand_ins
from tests.recon.acquisition.stand_ins import Bench, BenchCamera, Scripted

LIMITS = Limits(saturated=0.05)


@pytest.fixture(autouse=True)
def larger(monkeypatch):
    """Cameras with room for a few periods."""
    monkeypatch.setattr(stand_ins, "SIZE", (384, 288))
    monkeypatch.setattr(stand_ins, "RASTER", (416, 300))


def patterns() -> Patterns:
    parts = [
        part
        for axis in ("columns", "rows")
        for part in (Fringes(axis=axis, pitch=16, steps=4), GrayCode(axis=axis, pitch=16, bits=5))
    ]
    return Patterns(projector_size=stand_ins.RASTER, unwrap="gray", parts=tuple(parts))


def striped(shift: float) -> np.ndarray:
    """Reflectance of stripes."""
    across = 0.5 + 0.4 * np.sin((np.arange(stand_ins.SIZE[0]) + shift) / 9)
    return np.tile(across, (stand_ins.SIZE[1], 1))


def bench() -> tuple[Bench, Stage]:
    made = Bench(0.5)
    return made, Stage(made, {"cam1": BenchCamera("cam1", made)}, Triggered(timeout_s=0.01))


def surface(tmp_path, stage, operator, said):
    chosen = patterns()
    plan = SurfacePlan(chosen, list(images(chosen)), Exposing(level=0.8), LIMITS)
    with open_recording(tmp_path / "out") as recording:
        return record_surface(recording, stage, operator, plan, said.append, hidden)


def test_a_surface_without_faults_is_kept_at_once(tmp_path):
    _, stage = bench()
    operator = Scripted(["wait", "take"])
    assert surface(tmp_path, stage, operator, [])
    assert len(operator.asked) == 1 and "surface" in read_manifest(tmp_path / "out").contents


def test_faults_are_asked_about(tmp_path):
    """A dark thing: not kept if the operator ends instead of a second try before anything was taken, kept if after it."""
    made, stage = bench()
    made.reflectance[:] = 1e-4
    operator = Scripted(["take", "end"])
    assert surface(tmp_path, stage, operator, [])
    assert "no fringes" in operator.asked[1].text and "dark" in operator.asked[1].text
    assert not surface(tmp_path, stage, Scripted(["end"]), [])


def test_what_moves_meanwhile_is_a_fault(tmp_path):
    made, stage = bench()
    made.reflectance = striped(0)
    show = made.show
    made.show = lambda pattern: (setattr(made, "reflectance", striped(max(made.shows - 12, 0))), show(pattern))[1]
    operator = Scripted(["take", "end"])
    surface(tmp_path, stage, operator, [])
    assert "cam1 moved" in operator.asked[1].text
