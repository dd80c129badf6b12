"""A whole session, rendered small, from images to a volume with its truth taken away."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.capture import probe_files
from recon.files import metrics
from recon.files.written_files import LIST
from recon.probe_calibration.repeatability import five_points
from scenes.board_poses import Config as BoardPoses
from sonotwin import choices, rendered_session, session_accuracy
from sonotwin.cli import main
from sonotwin.rendered_session import Rendering
from sonotwin.verbs import sweep
from twin.evaluation import session_errors, sweep_errors, track_errors
from twin.shooting import FilmQuality, FrameShooting
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.timed_sweep import Clocks

COARSE = FrameShooting(quality=FilmQuality(disc=1, rim=4))
STROKE = {"start_mm": (-18, -12), "end_mm": (-18, 8), "speed_mm_s": 20}


def parts(out: Path) -> Iterator[Rendering]:
    """Parts of a session as accuracy has them, fewer and coarser."""
    usual = session_accuracy.settings("ideal", 0)
    small = {
        "poses": BoardPoses.model_validate(choices.read("poses", "demo")),
        "tracing": usual.tracing.model_copy(update={"samples": 4}),
        "path": SurfacePath.model_validate(choices.read("path", "stroke") | STROKE),
        "clocks": Clocks(camera_hz=20),
    }
    chosen = usual.model_copy(update=small | {"wires": 20, "bottom_s": 4.0})
    for part in rendered_session.parts(chosen, out, bottom_hz=15.0):
        coarse = {"frames": COARSE} if isinstance(part.settings, sweep.Config) else {}
        yield replace(part, settings=part.settings.model_copy(update=coarse))


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("session") / "out"
    for part in parts(out):
        part.run()
    return out


@pytest.fixture(scope="module")
def result(session) -> Path:
    """Made while the truth is elsewhere."""
    (session / "truth").rename(session.parent / "truth")
    out = session.parent / "result"
    fields = [f"capture={session / 'capture'}", "temperature_c=22", "tissue_m_s=1450", "find=nothing", f"out={out}"]
    assert main(["reconstruct", *fields]) == 0
    (session.parent / "truth").rename(session / "truth")
    return out


@pytest.mark.slow
def test_the_parts_are_measured_from_their_images_alone(session, result):
    """Loose bars: the session is small and coarse; the accuracy of whole ones is measured elsewhere."""
    figures = session_errors.measure(result, session / "capture", session / "truth")
    for name in ("wires", "bottom", "scan"):
        assert figures[f"{name}_track_visible_found"] == figures[f"{name}_track_visible"] > 0
        assert figures[f"{name}_track_false"] == 0 and figures[f"{name}_track_shift_median_mm"] < 0.1
    lag = json.loads((result / "latency" / "lag.json").read_text())
    assert abs(lag["lag_s"] - 0.05) < 0.004
    truth = sweep_errors.read_truth(session / "truth", "scan")
    probe = probe_files.read(result / "probe" / "probe.yaml")
    error, sigma = sweep_errors.probe_errors(probe, truth, five_points(truth.transducer.image_size))
    assert error.max() < 0.6 and (error < 4 * sigma).all()
    assert metrics.read(result / "metrics.json")["surface_points"] > 500_000
    assert (result / "volume" / "scan" / "volume.nrrd").is_file()


@pytest.mark.slow
def test_a_lost_step_and_those_that_build_on_it_come_back_to_the_same_bytes(session, result, capsys):
    """But for the seconds in metrics.json, and its digest in the list. Nothing else is done again."""

    def contents() -> dict[str, bytes]:
        files = (path for path in sorted(result.rglob("*")) if path.is_file() and path.name not in (metrics.FILE, LIST))
        return {str(path.relative_to(result)): path.read_bytes() for path in files}

    before = contents()
    shutil.rmtree(result / "poses" / "wires")
    fields = [f"capture={session / 'capture'}", "temperature_c=22", "tissue_m_s=1450", "find=nothing", f"out={result}"]
    capsys.readouterr()
    assert main(["reconstruct", *fields]) == 0
    said = capsys.readouterr().out
    assert all(f"kept        {name}" in said for name in ("optics", "surface", "poses/scan", "latency", "volume/scan"))
    assert contents() == before


@pytest.mark.slow
def test_the_truth_of_the_frames_is_the_path_s(session):
    """The board moves over an exposure as fast as from frame to frame, and is seen whole in most of them."""
    with np.load(session / "truth" / "sweep" / "scan" / "film.npz") as film:
        places, speed = film["world_from_target"][:, :3, 3], film["shift_mm"] / 0.01
    between = (places[2:] - places[:-2]) * 20 / 2
    assert np.median(np.linalg.norm(speed[1:-1] - between, axis=1)) < 0.1 * np.median(np.linalg.norm(between, axis=1))
    assert track_errors.visible_whole(track_errors.read_truth(session / "truth", "scan")).mean() > 0.9
