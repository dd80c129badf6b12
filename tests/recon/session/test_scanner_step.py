"""What sweeps show of a scanner, of made speckle, and poses of a probe on a slide."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.capture import sweep_tables
from recon.capture.manifest import read_manifest
from recon.errors import InputError
from recon.geometry import rigid
from recon.identification.estimates import Estimate, Findings
from recon.session import scanner_step
from sonotwin import choices
from tests.recon.session import speckle_captures
from twin.ultrasound.transducer import Transducer

DEAD, COVERED = 17, 30  # columns
TURN_DEG, SHIFT_MM = 0.05, 0.09  # noise of tracking, at the image


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """A dead column, and one whose contact is poor: dark in tissue, not in air."""
    rng, folder = np.random.default_rng(3), tmp_path_factory.mktemp("scanner") / "capture"
    tissue, air = speckle_captures.speckle(12, -22.0, rng).astype(int), speckle_captures.in_air(6, rng).astype(int)
    tissue[..., [DEAD, COVERED]] -= 25
    air[..., DEAD] -= 25
    images = {name: stack.clip(0, 255).astype(np.uint8) for name, stack in (("tissue", tissue), ("air", air))}
    speckle_captures.write(folder, images, rng)
    return folder


def identified(capture: Path, **fields) -> scanner_step.Found:
    given = {"tissue": "tissue", "air": "air", "mm_per_px": speckle_captures.MM_PER_PX} | fields
    settings = scanner_step.Fields(ultrasound=Transducer(), **given)
    found = scanner_step.identify(settings, capture, read_manifest(capture), choices.read_rig())
    assert found is not None
    return found


@pytest.fixture(scope="module")
def found(capture) -> scanner_step.Found:
    return identified(capture)


def test_sweeps_show_the_grey_map_and_the_clock(found):
    """Within 4 standard deviations, which are small."""
    truth = {
        "ultrasound.dynamic_range_db": (255 / speckle_captures.GREYS_A_DB, 0.02),
        "ultrasound.face_ring_mm": (0.35, 0.2),
        "clocks.scanner_hz": (speckle_captures.HZ, 0.01),
        "clocks.scanner_jitter_s": (speckle_captures.JITTER_S, 0.3),
    }
    for name, (true, relative) in truth.items():
        one = found.findings.estimates[name]
        assert abs(one.value - true) < 4 * one.sigma and one.sigma < relative * true, name
    assert "attenuation isn't given" in found.findings.unknown["ultrasound.tgc_db_per_cm_mhz"]
    assert "side by side" in found.findings.unknown["ultrasound.elevation_mm"]


def test_a_dead_column_is_dark_in_air_too(found):
    assert [name for name in found.findings.estimates if name.startswith("dark")] == [f"dark_columns.{DEAD}"]
    assert found.findings.unknown["dark_columns"].startswith(f"{COVERED} are dark in tissue, but ring in air")


def test_the_description_has_the_recorded_image_and_what_was_measured(found, tmp_path):
    """Read back as a transducer; what isn't measured is as of the one that it began with."""
    scanner_step.write(tmp_path / "ours.yaml", found, "phantom")
    text = (tmp_path / "ours.yaml").read_text()
    ours = Transducer.model_validate(choices.read("ultrasound", tmp_path / "ours.yaml"))
    assert ours.image_size == speckle_captures.SIZE == found.rig.probe.image_size
    assert ours.scale_mm_per_px == speckle_captures.MM_PER_PX == found.rig.probe.scale_mm_per_px
    one = found.findings.estimates["ultrasound.dynamic_range_db"]
    assert abs(ours.dynamic_range_db - one.value) < 0.1 * one.sigma and ours.elevation_mm == Transducer().elevation_mm
    assert "# ± " in text and "elevation_mm: 4.5  # not measured: no B-scans of even tissue side by side" in text


def test_a_number_that_the_scanner_does_not_have_is_named_as_its(found):
    settings = scanner_step.Fields(ultrasound=Transducer())
    wrong = Findings({"ultrasound.colour": Estimate(1.0, 0.1, "B-scans")})
    with pytest.raises(InputError, match=r"^ultrasound: expected the name of one of its numbers, found colour$"):
        scanner_step.described(settings, Transducer().model_dump(mode="json"), found.rig, wrong)


def test_dropped_b_scans_leave_the_rate(capture, tmp_path, monkeypatch):
    """Frames keep their numbers: every third is lost."""
    monkeypatch.setattr(scanner_step.scanner, "identify", lambda *_: Findings())
    shutil.copytree(capture, tmp_path / "capture")
    scans = tmp_path / "capture" / "sweep" / "tissue" / "us"
    frames, times = sweep_tables.read_stamps(scans / "timestamps.csv")
    kept = frames % 3 != 1
    sweep_tables.write_rows(
        scans / "timestamps.csv", sweep_tables.STAMPS, zip(frames[kept].tolist(), times[kept].tolist(), strict=True)
    )
    settings = scanner_step.Fields(ultrasound=Transducer(), tissue="tissue", mm_per_px=speckle_captures.MM_PER_PX)
    manifest = read_manifest(tmp_path / "capture")
    found = scanner_step.identify(settings, tmp_path / "capture", manifest, choices.read_rig())
    assert found is not None
    one = found.findings.estimates["clocks.scanner_hz"]
    assert abs(one.value - speckle_captures.HZ) < 4 * one.sigma < 0.6


def slid(rng: np.random.Generator, hand_mm: float = 0.0, hand_deg: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tracked poses : (n, 4, 4) of a probe that sets off gently along its own z and stops, with its way : (n,) mm, and times."""
    share = np.linspace(0, 1, 40)
    way = 6 * share * share * (3 - 2 * share)
    turn = Rotation.from_rotvec([0.4, -1.0, 0.3])
    turns = np.deg2rad(np.hypot(TURN_DEG, hand_deg)) * rng.standard_normal((40, 3))
    poses = np.stack([rigid.transform(one.as_matrix(), np.zeros(3)) for one in turn * Rotation.from_rotvec(turns)])
    poses[:, :3, 3] = way[:, None] * turn.as_matrix()[:, 2] + [10.0, 20, 650]
    poses[:, :3, 3] += np.hypot(SHIFT_MM, hand_mm) * rng.standard_normal((40, 3))
    return poses, way, np.rint(5e7 * np.arange(40)).astype(np.int64)


def test_errors_of_a_slides_way_are_as_large_as_is_said(rng):
    """Of distances from end to end, and from the first B-scan to the second, of 300 slides; 12 % are 3 sigma of their scatter."""
    z = []
    for _ in range(300):
        poses, way, times = slid(rng)
        led = scanner_step.on_slide(poses, times, times[::4])
        assert not isinstance(led, str)
        places, true, errors = led.poses[:, 2, 3], way[::4], led.errors_mm
        pairs = [(0, -1), (0, 1)]
        off = [places[b] - places[a] - (true[b] - true[a]) for a, b in pairs]
        z.append(np.divide(off, [np.linalg.norm(errors[:, b] - errors[:, a]) for a, b in pairs]))
    assert np.allclose(np.std(z, axis=0), 1, atol=0.12) and (np.abs(np.mean(z, axis=0)) < 3 / np.sqrt(300)).all()


def test_a_hand_is_no_slide(rng):
    poses, _, times = slid(rng, 0.15, 0.6)
    led = scanner_step.on_slide(poses, times, times)
    assert isinstance(led, str) and "put the probe on a slide" in led


def test_b_scans_side_by_side_are_a_fifth_of_a_millimetre_apart():
    """Of 400 at 0.02 mm, 40 of the middle."""
    poses = np.tile(np.eye(4), (400, 1, 1))
    poses[:, 2, 3] = 0.02 * np.arange(400)
    which = scanner_step.beside(poses)
    assert len(which) == 40 and (np.diff(which) == 10).all()
    poses[:, 2, 3] *= 20
    which = scanner_step.beside(poses)
    assert len(which) == 40 and (np.diff(which) == 1).all() and abs(which.mean() - 199.5) < 1
