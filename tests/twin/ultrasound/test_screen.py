"""A scanner's screen: the B-scan lies in it as it is, and the software places and finds it there."""

import numpy as np
import pytest
from pydantic import ValidationError

from recon.clips import image_region
from recon.session import masses_step
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.session import CAPTURE, Session
from twin.ultrasound import screen
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.sweep_session import calibration_of
from twin.ultrasound.timed_sweep import Clocks
from twin.ultrasound.transducer import Transducer

SCREEN = (640, 540)


@pytest.fixture(scope="module")
def read(rig, tmp_path_factory):
    """Scans of one sweep, with the B-scan alone and on a screen, as the pipeline reads them."""
    found = {}
    for name, size in (("alone", None), ("screen", SCREEN)):
        chosen = SweepSettings(
            rig=rig,
            scene={"kind": "breast"},
            ultrasound=Transducer(screen=size),
            path=SurfacePath(start_mm=(-8.0, -2.0), end_mm=(8.0, -2.0), speed_mm_s=8.0),
            clocks=Clocks(scanner_hz=4.0),
            seed=3,
        )
        planned, folder = plan_sweep(chosen), tmp_path_factory.mktemp(name)
        planned.write(Session(folder, "sweep", chosen.model_dump(mode="json")), planned.scans())
        clip = None if size is None else screen.part_of(chosen.ultrasound)
        found[name] = masses_step.read(masses_step.Settings(capture=folder / CAPTURE, clip=clip))
        found[f"{name}, whole"] = masses_step.read(masses_step.Settings(capture=folder / CAPTURE))
    return found


def test_the_clip_of_a_screen_is_the_b_scan_at_its_place(read):
    """Same greys, and same places in the world to a rounding."""
    alone, cut = read["alone"], read["screen"]
    np.testing.assert_array_equal(np.stack(list(cut.stream())), np.stack(list(alone.stream())))
    np.testing.assert_allclose(cut.world_from_pixel, alone.world_from_pixel, atol=1e-9)


def test_the_b_scan_is_found_by_what_changes(read):
    """Beside a clock that changes, too; without B-scans behind the clip's margin, as deep ones hardly change there."""
    u, v, width, height = screen.part_of(Transducer(screen=SCREEN))
    found = image_region.find(read["screen, whole"].stream(), "scan", "clip")
    assert found[:2] == pytest.approx((u, v), abs=9)
    assert (found[0] + found[2], found[1] + found[3]) == pytest.approx((u + width, v + height), abs=9)


def test_depths_count_from_the_face_on_the_screen(rig):
    alone, on_screen = (calibration_of(rig, Transducer(screen=size)) for size in (None, SCREEN))
    u, v, _, _ = screen.part_of(Transducer(screen=SCREEN))
    assert on_screen.face_row == v
    np.testing.assert_allclose(on_screen.to_target([u + 100.0, v + 50.0]), alone.to_target([100.0, 50.0]), atol=1e-9)


def test_a_screen_too_small_for_its_image_is_refused():
    with pytest.raises(ValidationError, match="screen: expected 441x498 px or more"):
        Transducer(screen=(400, 540))
