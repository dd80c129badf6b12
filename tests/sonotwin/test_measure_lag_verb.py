"""`sonotwin measure-lag`, from B-scans of a tank's bottom to the lag."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from recon.freehand import sequences
from recon.model.fan import Fan
from sonotwin.cli import main
from tests.recon import bscans, sweep_sets

LAG_S = 0.0473


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return sweep_sets.bottom(tmp_path_factory.mktemp("bottom") / "capture", np.random.default_rng(0), LAG_S)


def test_the_lag_is_found_and_said(capture, tmp_path, capsys):
    out = tmp_path / "lag"
    assert main(["measure-lag", f"capture={capture}", f"out={out}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["find", "lag", "scatter", "wrote"]
    assert lines[0].startswith("find        bottom in 86 of 86 B-scans, 252 poses") and "lag         47.3 ms, 47." in lines[1]
    found, figures = json.loads((out / "lag.json").read_text()), json.loads((out / "metrics.json").read_text())
    assert found["lag_s"] == pytest.approx(LAG_S, abs=0.001)
    assert found["interval_s"][0] <= found["lag_s"] <= found["interval_s"][1] and found["sigma_s"] > 0
    assert figures["lag_ms"] == pytest.approx(1e3 * found["lag_s"])
    with (out / "depths.csv").open(newline="") as stream:
        depths = [float(row["depth_px"]) for row in csv.DictReader(stream)]
    assert len(depths) == 86 and 150 < np.ptp(depths) < 200, "18 to 24 mm of 0.1225 mm/px"


def test_a_target_that_slips_far_is_said(tmp_path, caplog):
    """By 3 mm during the sweep: the lag is found all the same, and a usual bracket isn't what gave."""
    capture = sweep_sets.bottom(tmp_path / "capture", np.random.default_rng(0), LAG_S, slips_mm=3.0)
    assert main(["measure-lag", f"capture={capture}", f"out={tmp_path / 'lag'}"]) == 0
    assert "the bottom moved by -2.8 mm against the probe during the sweep: a bracket that slips" in caplog.text
    assert json.loads((tmp_path / "lag" / "lag.json").read_text())["lag_s"] == pytest.approx(LAG_S, abs=0.002)


def test_a_sequence_of_plus_tells_its_own_lag(capture, tmp_path):
    """Poses at the images' stamps, 15 a second, so less sure: by its own interval, of some ms. The screen's text is no bottom."""
    path = sweep_sets.recorded(tmp_path / "bottom.igs.mha", capture, screen=True)
    clip = f"clip=[{','.join(map(str, [*sweep_sets.BORDER, *bscans.SIZE]))}]"
    assert main(["measure-lag", f"sequence={path}", "reference=Tracker", clip, f"out={tmp_path / 'lag'}"]) == 0
    found = json.loads((tmp_path / "lag" / "lag.json").read_text())
    assert found["interval_s"][0] <= LAG_S <= found["interval_s"][1] and found["sigma_s"] < 0.003
    with (tmp_path / "lag" / "depths.csv").open(newline="") as stream:
        depths = [float(row["depth_px"]) for row in csv.DictReader(stream)]
    assert len(depths) == 86 and min(depths) > sweep_sets.BORDER[1] + 32, "of the whole screen's rows"


def test_the_bottom_is_found_on_a_screen(capture, tmp_path, capsys):
    """B-scans in a third of a screen's width, beside bright texts: the part that changes is found, and said."""
    path, beside = sweep_sets.recorded(tmp_path / "bare.igs.mha", capture), (420, 50)
    frames = sequences.read_sequence(path)
    screens = np.zeros((len(frames.images), 500, 1100), np.uint8)
    screens[:, ::40, :380] = 255
    width, height = bscans.SIZE
    screens[:, beside[1] : beside[1] + height, beside[0] : beside[0] + width] = frames.images
    sequences.write_sequence(tmp_path / "screen.igs.mha", dataclasses.replace(frames, images=screens))
    fields = ["measure-lag", f"sequence={tmp_path / 'screen.igs.mha'}", "reference=Tracker", f"out={tmp_path / 'lag'}"]
    assert main(fields) == 0
    assert "screen      looked in what changes from image to image, clip=[" in capsys.readouterr().out
    found = json.loads((tmp_path / "lag" / "lag.json").read_text())
    assert found["interval_s"][0] <= LAG_S <= found["interval_s"][1]


def test_a_fan_is_given_or_found(capture, tmp_path, capsys):
    """B-scans cut to a fan, beside which the screen is grey."""
    path, fan = sweep_sets.recorded(tmp_path / "bare.igs.mha", capture), Fan(160.0, -150.0, 152.0, 540.0, -24.0, 24.0)
    frames = sequences.read_sequence(path)
    inside = fan.mask(frames.images.shape[1:])
    v, u = np.mgrid[: inside.shape[0], : inside.shape[1]]
    moving = np.random.default_rng(1).integers(0, 12, frames.images.shape, np.uint8)  # noise that a scanner's gain shows
    ring = np.uint8(120 * np.exp(-np.maximum(np.hypot(u - fan.u, v - fan.v) - fan.first_px, 0) / 8))
    images = np.where(inside, np.maximum(frames.images, moving + ring), 60).astype(np.uint8)
    sequences.write_sequence(tmp_path / "fan.igs.mha", dataclasses.replace(frames, images=images))
    fields = ["measure-lag", f"sequence={tmp_path / 'fan.igs.mha'}", "reference=Tracker", f"out={tmp_path / 'lag'}", "top_px=20"]
    for setting in ("fan=find", "fan=[160,-150,152,540,-24,24]"):
        assert main([*fields, setting]) == 0
        console = capsys.readouterr().out
        assert ("fan         in what changes" in console) == (setting == "fan=find")
        found = json.loads((tmp_path / "lag" / "lag.json").read_text())
        assert found["interval_s"][0] <= LAG_S <= found["interval_s"][1] and found["sigma_s"] < 0.004


def test_what_is_wrong_is_said_in_one_line(capture, tmp_path, capsys):
    def complaint(*fields: str) -> str:
        assert main(["measure-lag", f"capture={capture}", f"out={tmp_path / 'out'}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    assert complaint("search_s=[0.5,-0.5]").startswith("measure-lag: search_s: expected two lags, the less one first")
    assert complaint("search_s=[-0.5,0.03]").startswith("bottom: search_s: expected the lag within -0.5 to 0.03 s")
    assert complaint("search_s=[50,51]").startswith("bottom: times: expected poses at 60 % of the images or more")
    assert complaint("top_px=407") == "bottom: depths: expected at least 20 images that show the bottom, found 0"
    assert complaint("sequence=a.igs.mha") == "measure-lag: expected capture or sequence, found both"
    assert complaint("target=Stylus") == (
        "measure-lag: target: expected none without a sequence, of which it names a frame, found Stylus"
    )
    assert complaint("clip=[400,0,10,10]").startswith("clip: expected a part of an image of 321x408")
    assert complaint("top_px=-1").startswith("measure-lag: top_px: expected ")
    assert "expected a folder apart from what is read" in complaint(f"out={capture}")
    assert not (tmp_path / "out").exists()
