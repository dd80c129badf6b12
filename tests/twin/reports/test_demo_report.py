"""The report, read as a person reads it: opened in a browser from the file alone."""

import base64
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.capture.surface_part import read_surface
from recon.reports import figures
from recon.structured_light import decode, triangulate
from tests.patience import PATIENCE_S
from tests.twin import drawn_sweep
from twin.evaluation import error_parts, surface_errors
from twin.reports import demo_report

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SOFTWARE_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WATCH = """<script>
const complaints = [];
console.error = (...parts) => complaints.push(parts.join(" "));
window.addEventListener("error", event => complaints.push(event.message));
window.addEventListener("unhandledrejection", event => complaints.push(String(event.reason)));
</script>"""
TELL = """<script>
(async () => {
  const view = document.getElementById("surface"), wait = () => new Promise(resolve => setTimeout(resolve, 20));
  while (!view.dataset.drawn && !complaints.length) await wait();
  const pictures = {};
  for (const button of document.querySelectorAll("[data-colour]")) {
    button.click();
    await wait();
    pictures[button.dataset.colour] = await Plotly.toImage(view, { format: "png", width: 480, height: 360 });
  }
  const inside = document.getElementById("inside");
  while (!inside.dataset.drawn && !complaints.length) await wait();
  pictures.inside = await Plotly.toImage(inside, { format: "png", width: 480, height: 360 });
  const fetched = performance.getEntriesByType("resource").map(entry => entry.name).filter(name => !name.startsWith("data:"));
  const broken = [...document.images].filter(image => image.src && !image.naturalWidth).length;
  const answer = document.createElement("pre");
  answer.id = "answer";
  answer.textContent = JSON.stringify({ complaints, pictures, fetched, broken, wide: document.documentElement.scrollWidth });
  document.body.append(answer);
})();
</script>"""


@pytest.fixture(scope="module")
def story(session, tmp_path_factory):
    """What is told of the drawn session."""
    path = tmp_path_factory.mktemp("points") / "points.npz"
    shots = read_surface(session.folder / "capture")
    points = triangulate.triangulate(decode.decode(shots.images, shots.patterns), session.camera, session.projector)
    np.savez(path, points=points.points, sigma=points.sigma)
    return demo_report.read(session.folder / "capture", session.folder / "truth", path)


@pytest.fixture(scope="module")
def inside(rig, tmp_path_factory):
    """What ultrasound adds to it."""
    return drawn_sweep.inside(tmp_path_factory.mktemp("inside"), rig, np.random.default_rng(7))


@pytest.fixture(scope="module")
def written(story, inside, tmp_path_factory):
    """A report of the drawn session: its text."""
    folder = tmp_path_factory.mktemp("report")
    metrics = surface_errors.measure(story.points, story.comparison, story.truth) | drawn_sweep.figures(inside)
    outputs, commands = [("surface.ply", "the <mesh>")], ["sonotwin demo 'out=a b'"]
    demo_report.write(folder / "report.html", story, metrics, outputs, commands, inside)
    return (folder / "report.html").read_text(encoding="utf-8")


def words_of(page):
    """What a person reads; spaces that don't break are spaces."""
    text = re.sub("<(script|style|svg).*?</\\1>", "", page, flags=re.DOTALL)
    return re.sub("[\u00a0\u202f]", " ", html.unescape(re.sub("<[^>]*>", " ", text)))


def test_the_report_says_what_was_measured(written):
    shown = words_of(written)
    for text in (
        "Paper, limit, here",
        "0.101 to 0.131 mm",
        "0.045 mm",
        "not measured",
        "Wrapped phase",
        "Gray code",
        "the <mesh>",
    ):
        assert text in shown
    assert "sonotwin demo 'out=a b'" in shown
    assert re.search(r"Sphere, error of the radius\s+0.045 mm\s+0.\d{4} mm", shown)
    assert "Cylinder, error of the radius" not in shown, "the scene has none"


def test_the_report_says_what_ultrasound_found(written):
    """One tumour of two, off by 0.5 mm; the other in no more figures than are known of it."""
    shown = words_of(written)
    assert "Ultrasound found 1 of 2 tumours inside it, its centre off by 0.50 mm." in shown
    assert re.search(r"Tumour 1\s+12\.0 / 12\.0\s+0\.90 / 0\.90\s+0\.50\s+0\.29\s+0\.9\d+\s+.* yes", shown)
    assert re.search(r"Tumour 2\s+unknown / 8\.0\s+unknown / 0\.27\s+unknown .* not found", shown)
    assert "1450 m/s in this tissue" in shown and "shown 20 mm deep lies 1.2 mm less deep" in shown
    assert re.search(r"Image centre, off by\s+0\.274 mm\s+0\.\d{3} mm\s+0\.200 mm", shown)
    assert re.search(
        r"Lag of the scanner’s images\s+not measured\s+4\d\.\d to 5\d\.\d ms \(95 %\)\s+\d\d\.\d ms; true 50\.0", shown
    )


def test_a_report_of_next_to_nothing_is_written(story, tmp_path):
    """Three points, all of them wrong by 20 mm and without a prediction: the page says what is unknown."""
    points = np.full_like(story.points, np.nan)
    few = tuple(np.argwhere(story.truth.lit)[:3].T)
    points[few] = story.truth.points[few] + np.float32([0, 0, 20])
    comparison = surface_errors.compare(points, np.full_like(points[..., 0], np.nan), story.truth)
    thin = replace(story, points=points, comparison=comparison, parts=error_parts.split(comparison, None))
    demo_report.write(tmp_path / "report.html", thin, surface_errors.measure(points, comparison, story.truth), [], [])
    text = re.sub("<script.*?</script>", "", (tmp_path / "report.html").read_text(encoding="utf-8"), flags=re.DOTALL)
    assert "unknown" in text and "has a prediction to compare with" in text and not re.search(r"\bnan\b", text)


def test_the_dark_of_ten_bits_has_no_phase(story, monkeypatch):
    """Four of 1023 levels are noise where four of 255 are a signal: what the decoder takes for dark is shown as such."""
    images = np.uint16(np.rint(story.shots.images * (1023 / 255)))
    found = decode.decode(images, story.shots.patterns, bits=10)
    drawn = {}
    monkeypatch.setattr(
        demo_report.page, "picture", lambda colours, caption, *rest: drawn.setdefault(caption, colours) is None or ""
    )
    demo_report.decoding(replace(story, shots=replace(story.shots, images=images, bits=10), found=found))
    shown = drawn["Wrapped phase"][..., 3] > 0
    assert (found.modulation[found.status == decode.Status.DARK] > 4).any()
    assert np.array_equal(shown, found.status != decode.Status.DARK)


def test_the_report_stands_alone(written):
    """Nothing is loaded from elsewhere, and the file can be sent by mail."""
    page = re.sub("<script>.*?</script>", "", written, flags=re.DOTALL)
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)|url\((?!#)|@import""", page)
    assert len(written) < 12e6


def test_the_report_opens_in_a_browser(written, tmp_path):
    """No complaint, no request, no broken picture; the surface is drawn, and its colours can be changed."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"no browser found among {', '.join(BROWSERS)}; `apt-get install chromium` brings one")
    page = tmp_path / "report.html"
    page.write_text(written.replace("<head>", "<head>" + WATCH, 1).replace("</body>", TELL + "</body>"), encoding="utf-8")
    quiet = ("--no-sandbox", "--no-first-run", f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1280,900")
    command = [browser, "--headless=new", *quiet, *SOFTWARE_WEBGL, "--virtual-time-budget=30000", "--dump-dom", page.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True).stdout
    found = re.search('<pre id="answer">(.*?)</pre>', dom, flags=re.DOTALL)
    assert found, "the page's scripts did not come to their end"
    answer = json.loads(html.unescape(found[1]))
    assert (answer["complaints"], answer["fetched"], answer["broken"]) == ([], [], 0)
    assert answer["wide"] <= 1280
    pictures = {name: decoded(url) for name, url in answer["pictures"].items()}
    assert set(pictures) == {"error", "depth", "plain", "inside"}
    for picture in pictures.values():
        middle = picture[90:270, 120:360]
        assert (middle[..., 3] > 0).mean() > 0.3, "no surface in the middle of the view"
        assert middle[..., :3].std() > 5
    assert np.abs(pictures["error"].astype(int) - pictures["depth"]).mean() > 3
    assert np.abs(pictures["plain"].astype(int) - pictures["depth"]).mean() > 3


def decoded(url):
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def test_colours_are_those_of_the_scale_and_holes_are_transparent():
    picture = figures.Scale("gray", -1, 1)(np.array([[-1, 0, 1, 7, np.nan]], np.float32))
    assert picture[0, :4, 0].tolist() == [0, 128, 255, 255]
    assert picture[0, :, 3].tolist() == [255, 255, 255, 255, 0]


def test_a_histogram_keeps_to_the_colour_of_the_page(rng):
    drawing = figures.histogram(rng.standard_normal(5000), figures.standard_normal(4), "z", 4)
    assert drawing.startswith("<svg") and "currentColor" in drawing and "#000000" not in drawing


def test_densities_integrate_to_one(rng):
    for curve in (figures.standard_normal(6), figures.noise_mixture(rng.uniform(0.02, 0.05, 1000), 0.3, "noise")):
        assert np.trapezoid(curve.density, curve.x) == pytest.approx(1, abs=1e-3)


def test_local_means_ignore_what_is_masked():
    values = np.full((20, 20), 0.5, np.float32)
    values[5, 5] = np.nan
    mean = error_parts.local_mean(values, np.isfinite(values), 5)
    assert np.isnan(mean[5, 5])
    assert np.allclose(np.delete(mean.ravel(), 105), 0.5)
