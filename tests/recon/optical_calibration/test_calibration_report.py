"""The calibration's page, read as a person reads it: the text, and in a browser."""

import html
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from recon.model.calibration import Calibration
from recon.optical_calibration import calibration_report, figures_of_merit, joint_calibration
from recon.reports import figures
from tests.patience import PATIENCE_S
from tests.recon import board_sets

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
WATCH = """<script>
const complaints = [];
console.error = (...parts) => complaints.push(parts.join(" "));
window.addEventListener("error", event => complaints.push(event.message));
</script>"""
TELL = """<script>
window.addEventListener("load", () => {
  const fetched = performance.getEntriesByType("resource").map(entry => entry.name).filter(name => !name.startsWith("data:"));
  const broken = [...document.images].filter(image => image.src && !image.naturalWidth).length;
  const answer = document.createElement("pre");
  answer.id = "answer";
  const drawings = [...document.querySelectorAll("figure svg")].filter(svg => svg.getBoundingClientRect().height > 100).length;
  answer.textContent = JSON.stringify({ complaints, fetched, broken, drawings, wide: document.documentElement.scrollWidth });
  document.body.append(answer);
});
</script>"""


def calibrated(rig, devices, poses=12):
    cameras = {name: camera for name, camera in board_sets.devices(rig).items() if name in devices}
    rng = np.random.default_rng(3)
    sightings = board_sets.sightings(cameras, board_sets.random_poses(cameras, poses, rng), rng)
    sizes = {name: camera.size for name, camera in cameras.items()}
    settings = joint_calibration.Settings(distortion="decentred")
    return joint_calibration.calibrate(sightings, board_sets.BOARD, sizes, settings), Calibration(cameras)


@pytest.fixture(scope="module")
def story(rig):
    """A result as it comes, with what seldom comes: a warning, a dropped pose, scores, a bad half."""
    result, truth = calibrated(rig, board_sets.DEVICES)
    halves = result.halves.copy()
    halves[0] = -7.25
    scores = {device: {"none": 0.2, "decentred": 0.0151, "brown": 0.0152} for device in board_sets.DEVICES}
    dropped = {"<17>": "contradicts the other poses by 3.1 px in cam2"}
    return replace(result, halves=halves, scores=scores, dropped=dropped, warnings=("cam2: <seen> too little",)), truth


@pytest.fixture(scope="module")
def written(story, tmp_path_factory):
    result, truth = story
    path = tmp_path_factory.mktemp("page") / "calibration.html"
    measured = figures_of_merit.measure(result, truth)
    calibration_report.write(
        path, result, measured, [("optics.yaml", "all <devices>")], ["sonotwin calibrate-optics 'out=a b'"], truth
    )
    return path.read_text(encoding="utf-8")


def text_of(page: str) -> str:
    """What a person reads; a space that doesn't break is a space."""
    text = re.sub("<(script|style|svg).*?</\\1>", "", page, flags=re.DOTALL)
    return html.unescape(re.sub("<[^>]*>", " ", text)).replace("\u00a0", " ")


def test_the_page_says_what_came_out(story, written):
    shown, (result, _) = text_of(written), story
    for text in (
        "cam2: <seen> too little",
        "<17>",
        "contradicts the other poses",
        "all <devices>",
        "sonotwin calibrate-optics 'out=a b'",
    ):
        assert text in shown
    assert shown.index("too little") < shown.index("Residuals, camera 1"), "warnings come first"
    assert f"{result.rms['cam2']:.4f} px; the paper’s rig 0.151 px" in shown
    assert "−7.2 σ" in shown and "0.0151 px" in shown
    assert len(re.findall(r"\d\d\s+44\u202f/\u202f44\u202f/\u202f44", shown)) == 12, "a row a pose"


def test_numbers_stand_in_their_columns(story, written):
    """A pose's residuals by device, and a device's scores by model, with the one taken."""
    shown, (result, _) = text_of(written), story
    remaining = figures_of_merit.pose_rms(result)[3]
    assert len({f"{value:.4f}" for value in remaining}) == 3, "else an exchange would pass"
    assert re.search(r"\b03 .*?" + r"\s+".join(f"{value:.4f}" for value in remaining), shown)
    models = shown[shown.index("Distortion models") :]
    assert re.search(r"device\s+none\s+decentred\s+brown\s+taken", models)
    assert re.search(r"camera 2\s+0\.2000 px\s+0\.0151 px\s+0\.0152 px\s+decentred", models)


def test_the_opening_says_how_good_it_is(story, written):
    """In its sentence and in large figures."""
    result, truth = story
    measured = figures_of_merit.measure(result, truth)
    top = text_of(written)[: text_of(written).index("Residuals, camera 1")]
    assert top.count(f"{measured['point_sigma_mm']:.3f}") >= 2 and top.count(f"{measured['shape_sigma_mm']:.4f}") >= 2
    assert f"off by {measured['point_error_rms_mm']:.3f} mm and {measured['shape_error_rms_mm']:.4f} mm" in top


def test_parameters_stand_beside_the_true_ones(story, written):
    """As many decimals as the standard deviation has a use for."""
    result, _ = story
    camera, known = result.adjustment.calibration.cameras["cam2"], result.adjustment.calibration.uncertainty
    row = re.search(r"camera 2, fx\s+px\s+([\d.]+)\s+([\d.]+)\s+3318\.0*\s+([+−][\d.]+)\s+([+−][\d.]+)", text_of(written))
    assert row, "device, unit, value, standard deviation, truth, error, error in standard deviations"
    value, sigma = float(row[1]), float(row[2])
    assert value == pytest.approx(camera.matrix[0, 0], abs=sigma / 10) and sigma == pytest.approx(
        known.sigma("cam2.fx"), rel=0.06
    )
    error, ratio = (float(text.replace("−", "-")) for text in row.groups()[2:])
    assert error == pytest.approx(camera.matrix[0, 0] - 3318, abs=sigma / 10) and ratio == pytest.approx(error / sigma, abs=0.2)


def test_a_page_without_truth_projector_scores_and_halves(rig, tmp_path):
    """Four poses by two cameras are a calibration too; what is unknown is not said, and nothing is not a number."""
    result, _ = calibrated(rig, ("cam1", "cam2"), poses=4)
    calibration_report.write(tmp_path / "a.html", result, figures_of_merit.measure(result), [], [])
    shown = text_of((tmp_path / "a.html").read_text(encoding="utf-8"))
    assert "Too few poses to calibrate from two halves" in shown and "camera 2: decentred" in shown
    assert "only 4 poses" in shown
    assert not re.search(r"\bnan\b|\binf\b|true|[Pp]rojector,", shown)


def test_another_rig_is_not_compared_with_the_papers(story, tmp_path):
    """The same page of a camera whose focal length isn't that of the paper's rig."""
    result, _ = story
    adjusted = result.adjustment
    cameras = dict(adjusted.calibration.cameras)
    cameras["cam2"] = replace(cameras["cam2"], matrix=cameras["cam2"].matrix * [[0.9, 1, 1], [1, 0.9, 1], [1, 1, 1]])
    foreign = replace(result, adjustment=replace(adjusted, calibration=replace(adjusted.calibration, cameras=cameras)))
    calibration_report.write(tmp_path / "a.html", foreign, figures_of_merit.measure(result), [], [])
    assert "paper’s rig" not in text_of((tmp_path / "a.html").read_text(encoding="utf-8"))


def test_the_page_stands_alone(written):
    """Nothing is loaded from elsewhere, and without 3-D views there is no need of the program that draws them."""
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)|url\((?!#)|@import""", written)
    assert len(written) < 3e6


def test_the_page_opens_in_a_browser(written, tmp_path):
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"no browser found among {', '.join(BROWSERS)}; `apt-get install chromium` brings one")
    path = tmp_path / "calibration.html"
    path.write_text(written.replace("<head>", "<head>" + WATCH, 1).replace("</body>", TELL + "</body>"), encoding="utf-8")
    quiet = (
        "--no-sandbox",
        "--no-first-run",
        "--disable-gpu",
        f"--user-data-dir={tmp_path / 'profile'}",
        "--window-size=1280,900",
    )
    command = [browser, "--headless=new", *quiet, "--virtual-time-budget=10000", "--dump-dom", path.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True).stdout
    found = re.search('<pre id="answer">(.*?)</pre>', dom, flags=re.DOTALL)
    assert found, "the page's scripts did not come to their end"
    answer = json.loads(html.unescape(found[1]))
    assert (answer["complaints"], answer["fetched"], answer["broken"]) == ([], [], 0)
    assert answer["drawings"] == 3 * 4 + 2 and answer["wide"] <= 1280


def test_arrows_are_drawn_where_they_are(rng):
    """The drawing's path holds each start and each end, in the drawing's own units."""
    starts, vectors = rng.uniform(100, 900, (50, 2)), rng.normal(0, 0.1, (50, 2))
    svg = figures.arrows(starts, vectors, (1280, 1024), 200)
    paths = [np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", path), float) for path in re.findall(r' d="([^"]*)"', svg)]
    lines, dots = (path.reshape(50, 2, 2) for path in paths if len(path) == 100)
    scale = np.ptp(lines[:, 0, 0]) / np.ptp(starts[:, 0])
    assert (lines[:, 1] - lines[:, 0]) / scale == pytest.approx(200 * vectors, abs=0.01)
    assert dots[:, 0] == pytest.approx(lines[:, 0])
    assert "currentColor" in svg


def test_every_dot_is_drawn(rng):
    """Dots have no length, and must not be simplified away."""
    svg = figures.dots(
        rng.uniform(0, 900, (300, 2)), rng.uniform(600, 700, 300), figures.Scale("viridis", 600, 700), (1280, 1024)
    )
    assert sum(path.count("M ") for path in re.findall(r' d="([^"]*)"', svg)) >= 300


def test_magnification_is_round_and_suits_the_image():
    for length in (0.004, 0.07, 3.0):
        factor = figures.magnification((1280, 1024), length)
        assert f"{factor:e}"[0] in "125" and 0.01 * 1280 < factor * length < 0.05 * 1280
