"""`sonotwin export layout=screen`: a scanner's recording, which `import-sweep` reads back by the command that is printed."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.capture import sweep_part
from recon.capture.manifest import SCANNER, Device
from recon.capture.writer import new_capture
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from sonotwin.cli import main
from sonotwin.export_layouts import screen
from tests.recon.clips import made_clips
from tests.sonotwin.test_meza2021_verbs import contents

SCAN, COUNT, MS = (260, 220), 12, 1_000_000  # width and height, px; ns
PROBE = ProbeCalibration(rigid.from_rotation_vector([-1.5, 0.1, 0], [-70.0, 16, -48]), np.array([0.15, 0.2]))


def scans(seed: int = 0) -> np.ndarray:
    """Speckle under a face that rings for five rows, ever the same, with a corner that is black as where there is no contact."""
    images = made_clips.scans(COUNT, SCAN, seed)
    images[:, :5] = np.array([255, 255, 210, 160, 90])[:, None]
    images[:, 5:60, :40] = 0
    return images


def stamps(jitter_ms: float = 0.0) -> np.ndarray:
    """Times : (n,) ns of the B-scans, 50 ms apart."""
    off = np.random.default_rng(3).uniform(-jitter_ms, jitter_ms, COUNT)
    return 71_500 * MS + 50 * MS * np.arange(COUNT) + np.rint(MS * off).astype(np.int64)


def track() -> Track:
    """Poses each 25 ms; the target isn't found in one of them."""
    count = 2 * COUNT + 4
    poses = np.stack([rigid.from_rotation_vector([3, 0.02 * k, 0.1], [1.0 * k, 1 / 3, 600]) for k in range(count)])
    poses[7] = np.nan
    return Track(71_450 * MS + 25 * MS * np.arange(count), poses)


def captured(folder: Path, images=None, times=None, probe: ProbeCalibration | None = PROBE, **part) -> Path:
    images = scans() if images is None else images
    times = stamps() if times is None else times
    with new_capture(folder, "rig") as made:
        devices = {SCANNER: Device(size=images.shape[:0:-1])}
        made.add_sweep({SCANNER: times}, [(SCANNER, image) for image in images], devices, **{"track": track(), **part})
        if probe is not None:
            made.add_probe(probe)
    return folder


def exported(capture: Path, out: Path, *fields: str) -> int:
    return main(["export", "layout=screen", f"capture={capture}", f"out={out}", *fields])


def screens(folder: Path) -> np.ndarray:
    """All screens : (n, h, w)."""
    paths = sorted((folder / "screen").iterdir())
    assert [path.name for path in paths] == [f"{k:04d}.png" for k in range(COUNT)]
    return np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths])


def read_back(said: str, out: Path) -> sweep_part.SweepCapture:
    """Run the command that is printed."""
    (line,) = re.findall(r"^read +(sonotwin .*)$", said, re.MULTILINE)
    fields = [word for word in shlex.split(line)[1:] if word != "out=FOLDER"]
    assert main([*fields, f"out={out}"]) == 0
    return sweep_part.read_sweep(out)


def test_a_recording_comes_back(tmp_path, capsys):
    """B-scans to the byte, found on the screen; poses and times to rounding, and a pose that wasn't found."""
    assert exported(captured(tmp_path / "capture"), tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert f"{COUNT} images of 1024x768" in said and "which import-sweep finds by itself" in said
    assert "crop=" not in said.partition("sonotwin import-sweep")[2]
    sweep = read_back(said, tmp_path / "back")
    assert np.array_equal(np.stack(list(sweep.images())), scans())
    assert np.array_equal(sweep.track.times, track().times) and np.abs(sweep.times - stamps()).max() <= 1
    np.testing.assert_allclose(sweep.track.poses, track().poses, rtol=0, atol=1e-9)


def test_stamps_become_the_nearest_even_ones(tmp_path, capsys):
    """A scanner's recording has a rate alone; how far its times are off is said."""
    jittered = stamps(4.0)
    assert exported(captured(tmp_path / "capture", times=jittered), tmp_path / "out") == 0
    said = capsys.readouterr().out
    off_ms = float(re.findall(r"which are (\S+) ms off", said)[0])
    read = read_back(said, tmp_path / "back").times
    assert np.abs(read - jittered).max() == pytest.approx(off_ms * MS, abs=0.005 * MS + 2)  # of two decimals
    assert 1 < off_ms < 5 and np.ptp(np.diff(read)) <= 2  # ns


def test_the_clock_of_a_scanner_without_jitter_is_not_off(tmp_path, capsys):
    assert exported(captured(tmp_path / "capture"), tmp_path / "out") == 0
    assert "20 B-scans a second, which are 0.00 ms off" in capsys.readouterr().out


@pytest.mark.parametrize("rate_hz", [20, 29.97, 1e3 / 33])
def test_first_time_and_rate_have_the_digits_that_count(rate_hz):
    """A nanosecond at the end of the sweep is the clock's own."""
    numbers = np.arange(2000)
    times = 71_500_050_800_000 + np.rint(1e9 * numbers / rate_hz).astype(np.int64)
    starts_s, rate, _ = screen.even_clock(times, "capture")
    assert starts_s == 71500.0508 and len(f"{rate!r}") <= 14
    assert np.abs(numbers / rate - numbers / rate_hz).max() < 1e-9
    if rate_hz < 30:
        assert rate == rate_hz


@pytest.mark.parametrize(("pause_ms", "refused"), [(20, False), (400, True)])
def test_a_sweep_that_pauses_is_no_recording(pause_ms, refused, tmp_path, capsys):
    """Even times would lie nearer to other B-scans' stamps, and give wrong poses. There is a layout with a pose for each."""
    times = stamps() + pause_ms * MS * (np.arange(COUNT) >= 8)
    capture = captured(tmp_path / "capture", times=times)
    assert exported(capture, tmp_path / "out") == (2 if refused else 0)
    said = capsys.readouterr().err
    if refused:
        assert "capture: expected B-scans at an even rate, as images have no times of their own, found 0.05 to 0.45 s" in said
        assert "between them, the longest after B-scan 8; give layout=meza2021 frames=false" in said
        assert said.count("\n") == 1 and not (tmp_path / "out").exists()
        assert main(["export", "layout=meza2021", "frames=false", f"capture={capture}", f"out={tmp_path / 'other'}"]) == 0


def test_what_a_sweep_is_for_goes_along(tmp_path, capsys):
    capture = captured(tmp_path / "capture", name="wires", purpose="probe")
    assert exported(capture, tmp_path / "out", "sweep=wires", "implausible=take") == 0
    said = capsys.readouterr().out
    assert {"purpose=probe", "implausible=take"} < set(shlex.split(said.splitlines()[-2]))
    read_back(said, tmp_path / "back")


@pytest.mark.parametrize("edges", ["dark", "blind"])
def test_a_b_scan_that_is_still_at_its_edges_comes_with_its_place(edges, tmp_path, capsys):
    """As a fan, whose rectangle has black corners; or one that shows nothing at all."""
    images = scans()
    if edges == "dark":
        images[:, :20], images[:, :, -20:] = 0, 0
    else:
        images[:] = images[0]
    assert exported(captured(tmp_path / "capture", images), tmp_path / "out") == 0
    said = capsys.readouterr().out
    (crop,) = set(re.findall(r"crop=\[[\d,]+\]", said))
    assert f"at {crop}, to be given, as they don't change out to their edges" in said
    sweep = read_back(said, tmp_path / "back")
    assert np.array_equal(np.stack(list(sweep.images())), images)


def test_screens_differ_in_b_scan_clock_and_number_alone(tmp_path, capsys):
    """And in nothing that a wall clock or chance would bring."""
    for name, seed in (("one", 0), ("again", 0), ("other", 9)):
        assert exported(captured(tmp_path / f"{name}_capture", scans(seed)), tmp_path / name) == 0
    (u, v, width, height) = map(int, re.findall(r"crop=\[(\d+),(\d+),(\d+),(\d+)\]", capsys.readouterr().out)[0])
    assert contents(tmp_path / "one") == contents(tmp_path / "again")
    shown, others = screens(tmp_path / "one"), screens(tmp_path / "other")
    assert np.array_equal(shown[:, v : v + height, u : u + width], scans())
    for each in (shown, others):
        each[:, v : v + height, u : u + width] = 0
    assert np.array_equal(shown, others)
    changes = np.ptp(shown, axis=0) > 0
    clock, number = np.zeros_like(changes), np.zeros_like(changes)
    clock[10:35, -100:], number[90:110, -115:] = True, True
    assert (changes & clock).any() and (changes & number).any() and not (changes & ~clock & ~number).any()


def test_the_clock_is_that_of_the_time_stamps(tmp_path):
    """By hundredths of a second: one more is another picture, a thousandth isn't, nor is an hour."""
    shown = []
    for name, later in (("one", 0), ("thousandth", MS), ("hour", 3600_000 * MS), ("hundredth", 10 * MS)):
        late = replace(track(), times=track().times + later)
        capture = captured(tmp_path / f"{name}_capture", times=stamps() + later, track=late)
        assert exported(capture, tmp_path / name) == 0
        shown.append(screens(tmp_path / name)[:, 10:35, -100:])
    assert np.array_equal(shown[0], shown[1]) and np.array_equal(shown[0], shown[2])
    assert (shown[0] != shown[3]).any(axis=(1, 2)).all()


def test_ticks_are_as_deep_as_the_probe_says(tmp_path, capsys):
    """Those of a centimetre lie 50 px apart at 0.2 mm/px, from the face's row on; without a calibration there are none."""
    faced = replace(PROBE, face_row=6.0)
    for name, probe in (("with", faced), ("without", None)):
        assert exported(captured(tmp_path / f"{name}_capture", probe=probe), tmp_path / name) == 0
    (u, v, width, height) = map(int, re.findall(r"crop=\[(\d+),(\d+),(\d+),(\d+)\]", capsys.readouterr().out)[0])
    beside = np.s_[v - 5 : v + height + 20, u + width + 1 : u + width + 50]
    ticks = np.flatnonzero(screens(tmp_path / "with")[0][v : v + height, u + width + 24] > 150)
    assert ticks.tolist() == [6, 56, 106, 156, 206]
    assert not screens(tmp_path / "without")[0][beside].any()


def test_a_calibration_that_is_given_rules_the_ruler(tmp_path, capsys):
    from recon.capture import probe_files

    probe_files.write(tmp_path / "probe.yaml", replace(PROBE, scale=np.array([0.15, 0.1])))
    assert exported(captured(tmp_path / "capture"), tmp_path / "out", f"probe={tmp_path / 'probe.yaml'}") == 0
    (u, v, width, height) = map(int, re.findall(r"crop=\[(\d+),(\d+),(\d+),(\d+)\]", capsys.readouterr().out)[0])
    ticks = np.flatnonzero(screens(tmp_path / "out")[0][v : v + height, u + width + 24] > 150)
    assert ticks.tolist() == [0, 100, 200]


@pytest.mark.parametrize(("fields", "complaint"), [
    (["screen_px=[480,400]"], "export: screen_px: expected 504x324 px or more, for B-scans of 260x220 and all that is beside "
     "them, found 480x400; give screen_px=[504,324]"),
    (["screen_px=[1024,200]"], "screen_px"),
    (["lag_s=0.1"], "export: lag_s: expected none with layout=screen, which is of a sweep's B-scans and poses alone, found 0.1"),
    (["layout=meza2021", "screen_px=[800,600]"], "export: screen_px: expected none with layout=meza2021"),
    (["capture=[]"], "export: capture: needs a value; give capture=..."),
    (["sweep=scan"], "expected no name, as it is the only one, found scan"),
    (["probe={}/gone.yaml"], "gone.yaml: expected"),
])  # fmt: skip
def test_mistakes_are_one_line_and_nothing_is_written(fields, complaint, tmp_path, capsys):
    capture = captured(tmp_path / "capture")
    assert exported(capture, tmp_path / "out", *(field.format(tmp_path) for field in fields)) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_way_past_is_one(tmp_path, capsys):
    """The least screen that a refusal names is taken, and its B-scan found."""
    capture = captured(tmp_path / "capture")
    assert exported(capture, tmp_path / "out", "screen_px=[504,324]") == 0
    assert "B-scans at crop=[60,76,260,220], which import-sweep finds by itself" in capsys.readouterr().out


def test_a_single_b_scan_is_no_recording(tmp_path, capsys):
    capture = captured(tmp_path / "capture", scans()[:1], stamps()[:1])
    assert exported(capture, tmp_path / "out") == 2
    assert "expected two B-scans or more, as import-sweep takes, found 1" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("fields", [
    ("scene=patient", "ultrasound=clinic"),
    ("ultrasound=bright", "conditions=lifelike"),
    ("ultrasound.gel_mm=3", "path.tilt_deg=[14,0]"),  # one end of the array off the skin
])  # fmt: skip
def test_b_scans_of_the_twin_are_found_on_the_screen(fields, tmp_path, capsys):
    """To the pixel, whatever the face's ringing, the skin and the contact are."""
    stroke = ("path.start_mm=[4,-4]", "path.end_mm=[4,3.5]", "path.speed_mm_s=20")
    assert main(["sweep", *stroke, *fields, f"out={tmp_path / 'sweep'}"]) == 0
    assert exported(tmp_path / "sweep" / "capture", tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "which import-sweep finds by itself" in said
    back, sweep = read_back(said, tmp_path / "back"), sweep_part.read_sweep(tmp_path / "sweep" / "capture")
    assert np.array_equal(np.stack(list(back.images())), np.stack(list(sweep.images())))
    np.testing.assert_allclose(back.track.poses, sweep.track.poses, rtol=0, atol=1e-9)
