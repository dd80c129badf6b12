"""`sonotwin surface`, from a capture or a bare folder to files, on the ideal image of a tilted plane."""

import contextlib
import io
import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import sonotwin
from recon.capture import calibration_files, images, surface_part, writer
from recon.capture.manifest import Device, Manifest, SurfacePart, SweepPart
from recon.geometry import primitives, rigid
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.model.patterns import CentreLine, Fringes, GrayCode, Patterns, Uniform
from recon.tracking import networks
from sonotwin.cli import main
from tests import added
from tests.recon.tracking import films
from tests.recon.tracking.stand_ins import Told
from tests.twin.small_rigs import shrunk

SIZE, PROJECTOR = (320, 256), (640, 400)
SEQUENCES = {
    "centre_line": Patterns(projector_size=PROJECTOR, unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=12, steps=8))),
    "gray": Patterns(
        projector_size=PROJECTOR,
        unwrap="gray",
        parts=(Fringes(pitch=20, steps=8, origin=9.5), GrayCode(pitch=20, bits=5, start=-0.5, complementary=True)),
    ),
    "gray_alone": Patterns(
        projector_size=PROJECTOR, unwrap="gray", parts=(Uniform(), Uniform(level=0), GrayCode(pitch=1, bits=10, start=0))
    ),
}
TILT = rigid.from_rotation_vector([0.2, -0.3, 0], [0, 0, 660])  # world from the plane z = 0


@pytest.fixture(scope="module")
def optics() -> Calibration:
    lens = np.array([-0.1, 0.2, 0.0005, -0.0005, 0])
    camera = Camera(SIZE, np.array([[830.0, 0, 158], [0, 832, 127], [0, 0, 1]]), lens)
    pose = rigid.from_rotation_vector(np.deg2rad([0, -12.5, -1]), [148.0, 0, 15])
    projector = Camera(PROJECTOR, np.array([[960.0, 0, 315], [0, 963, 200], [0, 0, 1]]), lens / 2, pose)
    return Calibration({"cam1": camera, "projector": projector})


def photograph(patterns: Patterns, optics: Calibration, name: str = "cam1", world_from_plane: np.ndarray = TILT) -> np.ndarray:
    """What a camera sees of the patterns on the plane, with 1 DN of noise."""
    camera, projector = optics.cameras[name], optics.cameras["projector"]
    rays, normal = camera.pixel_rays(), world_from_plane[:3, 2]
    away = normal @ (world_from_plane[:3, 3] - camera.centre)
    points = camera.centre + rays * (away / (rays @ normal))[..., None]
    column = projector.project(points)[..., 0]
    profiles = np.array([profile for _, _, profile in patterns.profiles()], float)
    seen = np.array([np.interp(column, np.arange(len(profile)), profile) for profile in profiles])
    noise = np.random.default_rng(0).normal(0, 1, seen.shape)
    return np.clip(np.round(25 + 180 * seen + noise), 0, 255).astype(np.uint8)


def write_capture(folder: Path, patterns: Patterns, optics: Calibration) -> np.ndarray:
    """A capture of the plane under a sequence, whose images are returned."""
    images = photograph(patterns, optics)
    devices = {"cam1": Device(size=optics.cameras["cam1"].size, exposure_s=0.01), "projector": Device(size=PROJECTOR)}
    writer.write_surface(folder, {"cam1": images}, patterns, optics, devices)
    return images


@pytest.fixture(scope="module", params=SEQUENCES)
def shots(request, optics, tmp_path_factory) -> tuple[Path, np.ndarray, Patterns]:
    folder, patterns = tmp_path_factory.mktemp("shots") / "capture", SEQUENCES[request.param]
    return folder, write_capture(folder, patterns, optics), patterns


@pytest.fixture(scope="module")
def measured(shots) -> tuple[Path, list[str]]:
    """The folder of a capture's surface, and what was said."""
    out = shots[0].parent / "surface"
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["surface", f"capture={shots[0]}", f"out={out}"]) == 0
    return out, said.getvalue().splitlines()


@pytest.fixture
def capture(optics, tmp_path) -> Path:
    """A capture of one sequence, for tests that write to it or need no other."""
    write_capture(tmp_path / "capture", SEQUENCES["centre_line"], optics)
    return tmp_path / "capture"


def test_the_interface_gives_the_verbs_points(shots, measured, optics):
    """From arrays in memory."""
    _, images, patterns = shots
    camera, projector = optics.cameras["cam1"], optics.cameras["projector"]
    found = sonotwin.decode(images, patterns, camera="cam1")
    points = sonotwin.clean_surface(sonotwin.triangulate(found, camera, projector), camera, found.modulation)
    with np.load(measured[0] / "points.npz") as written:
        assert np.allclose(points.points, written["points"], atol=1e-4, equal_nan=True)
        assert np.allclose(points.sigma, written["sigma"], rtol=1e-4, equal_nan=True)


def test_a_capture_becomes_a_surface(shots, measured):
    out, lines = measured
    assert [line.split()[0] for line in lines] == ["decode", "unwrap", "triangulate", "wrote"]
    assert sorted(path.name for path in out.iterdir()) == [
        ".sonotwin.json",
        "metrics.json",
        "points.npz",
        "surface.glb",
        "surface.ply",
    ]

    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["points"] > 0.95 * SIZE[0] * SIZE[1]
    assert 85 < metrics["modulation_median_dn"] < 95 and metrics["saturated_fraction"] == 0
    assert {"seconds_read", "seconds_decode", "seconds_triangulate", "seconds_mesh"} <= metrics.keys()

    fit = primitives.fit_plane(trimesh.load(out / "surface.ply", process=False).vertices)
    assert np.linalg.norm(np.cross(fit.shape.normal, TILT[:3, 2])) < 1e-3
    close = 0.1 if shots[2].has_fringes("columns") else 0.15  # of a code, pixels right at borders are better than their sigma
    assert fit.rms == pytest.approx(metrics["predicted_rms_mm"], rel=close), "scatter about the plane, and its prediction"
    with np.load(out / "points.npz") as points:
        assert points["points"].shape == (SIZE[1], SIZE[0], 3)
        assert np.isfinite(points["sigma"]).sum() == metrics["points"]
        assert {"modulation", "status"} <= set(points)


def test_a_surface_that_loses_most_of_its_points_is_warned_of(optics, tmp_path, capsys):
    patterns = SEQUENCES["gray"]
    devices = {"cam1": Device(size=SIZE, exposure_s=0.01), "projector": Device(size=PROJECTOR)}
    writer.write_surface(tmp_path / "capture", {"cam1": photograph(patterns, optics)}, patterns, optics, devices)
    given = ["surface", f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'surface'}"]
    assert main(given) == 0 and "warning" not in capsys.readouterr().out
    with np.load(tmp_path / "surface" / "points.npz") as found:
        steps = found["sigma"] / (found["points"][..., 2] / 830)
    assert main([*given, f"limits.max_sigma={np.nanquantile(steps, 0.1):.6f}", "limits.min_island_px=1"]) == 0
    assert "warning     most of the points are unsure: does the calibration take points" in capsys.readouterr().out


def test_a_bare_folder_gives_the_same(shots, measured, optics, tmp_path):
    folder, _, patterns = shots
    (tmp_path / "sequence.yaml").write_text(patterns.model_dump_json())
    calibration_files.write(tmp_path / "optics.yaml", optics)
    source = [
        f"images={folder / 'surface' / 'cam1'}",
        f"patterns={tmp_path / 'sequence.yaml'}",
        f"calibration={tmp_path / 'optics.yaml'}",
    ]
    assert main(["surface", *source, f"out={tmp_path / 'a'}"]) == 0
    assert (tmp_path / "a" / "surface.ply").read_bytes() == (measured[0] / "surface.ply").read_bytes()


def test_a_code_too_coarse_for_a_surface_is_refused_by_the_cause(optics, tmp_path, capsys):
    """All points are there, but each may lie millimetres off; whoever wants them raises the limit."""
    coarse = Patterns(projector_size=PROJECTOR, unwrap="gray", parts=(GrayCode(pitch=8, bits=7, inverted=True),))
    devices = {"cam1": Device(size=SIZE), "projector": Device(size=PROJECTOR)}
    writer.write_surface(tmp_path / "capture", {"cam1": photograph(coarse, optics)}, coarse, optics, devices)
    fields = [f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'surface'}"]
    assert main(["surface", *fields]) == 2
    assert re.search(r"\d{5} points, all removed as unsure, .* is the pitch .* too coarse\?", capsys.readouterr().err)
    assert main(["surface", *fields, "limits.max_sigma=50"]) == 0


def test_mirrored_images_are_refused_unless_they_are_to_be_taken(optics, tmp_path, capsys, caplog):
    patterns = SEQUENCES["centre_line"]
    mirrored = np.ascontiguousarray(photograph(patterns, optics)[..., ::-1])
    devices = {"cam1": Device(size=SIZE), "projector": Device(size=PROJECTOR)}
    writer.write_surface(tmp_path / "capture", {"cam1": mirrored}, patterns, optics, devices)
    fields = [f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'surface'}"]
    assert main(["surface", *fields]) == 2 and not (tmp_path / "surface").exists()
    assert re.search("light the back .* mirrored .* give implausible=take\n$", capsys.readouterr().err)
    assert main(["surface", *fields, "implausible=take"]) == 0
    assert "taken all the same: the projector would light the back" in caplog.text


@pytest.mark.parametrize(("down", "said"), [("cam1", "% of the points"), ("", "sees 100 %")])
def test_a_second_camera_shows_images_upside_down(optics, tmp_path, capsys, caplog, down, said):
    """Of columns alone one camera can't: the same plane seems tilted the other way. A damaged second image isn't in the way."""
    patterns, steep = SEQUENCES["gray"], rigid.from_rotation_vector([0.9, -0.3, 0], [0, 0, 660])
    beside = rigid.from_rotation_vector(np.deg2rad([0, 12.5, 0]), [-148.0, 0, 15])
    optics = Calibration(optics.cameras | {"cam2": replace(optics.cameras["cam1"], camera_from_world=beside)})
    seen = {name: photograph(patterns, optics, name, steep)[:, :: -1 if name == down else 1] for name in ("cam1", "cam2")}
    devices = {"cam1": Device(size=SIZE), "cam2": Device(size=SIZE), "projector": Device(size=PROJECTOR)}
    writer.write_surface(tmp_path / "capture", seen, patterns, optics, devices)
    fields = [f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'surface'}"]
    if down:
        assert main(["surface", *fields]) == 2
        assert re.search(said + " lie where cam2 sees .* upside down.* give implausible=take", capsys.readouterr().err)
        assert main(["surface", *fields, "implausible=take"]) == 0 and "taken all the same" in caplog.text
        return
    assert main(["surface", *fields]) == 0 and said in capsys.readouterr().out
    (tmp_path / "capture" / "surface" / "cam2" / "0003.png").write_bytes(b"")
    assert main(["surface", *fields]) == 0 and "cam2 isn't compared: " in capsys.readouterr().out
    pair = {name: camera for name, camera in optics.cameras.items() if name != "cam2"}
    calibration_files.write(tmp_path / "pair.yaml", Calibration(pair))
    assert main(["surface", *fields, f"calibration={tmp_path / 'pair.yaml'}"]) == 0
    assert "cam2 isn't compared: it has no calibration" in capsys.readouterr().out


def test_results_are_replaced_but_other_folders_are_not(capture, tmp_path, capsys):
    out = tmp_path / "surface"
    for _ in range(2):
        assert main(["surface", f"capture={capture}", f"out={out}"]) == 0
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("mine")
    capsys.readouterr()
    assert main(["surface", f"capture={capture}", f"out={other}"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "found other files" in captured.err
    assert [path.name for path in other.iterdir()] == ["mine.txt"]


def test_results_of_other_commands_are_left_alone(capture, tmp_path, capsys):
    """They have a metrics.json too. What is read is never written over, whatever lies beside it."""
    for name in ("demo.json", "error_map.png", "manifest.json"):
        other = tmp_path / name.partition(".")[0]
        other.mkdir()
        (other / name).write_text("{}")
        (other / "metrics.json").write_text("{}")
        assert main(["surface", f"capture={capture}", f"out={other}"]) == 2
        assert len(list(other.iterdir())) == 2
    for out in (capture, capture.parent):
        (out / "points.npz").write_text("")
        capsys.readouterr()
        assert main(["surface", f"capture={capture}", f"out={out}"]) == 2
        assert "expected a folder apart from what is read" in capsys.readouterr().err
    assert (capture / "manifest.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "expected capture, or images with patterns and calibration, found none of them"),
        (["images=a"], "expected capture, or images with patterns and calibration, found images"),
        (["capture=a", "images=b"], "expected capture, or images with patterns and calibration, found both: images"),
        (["capture=nowhere"], "nowhere: expected a capture, found no such folder"),
        (["images=a", "patterns=nowhere.yaml", "calibration=c"], "or a YAML file, found none at nowhere.yaml"),
        (["capture=nowhere", "limits.max_sigma=-1"], "limits.max_sigma"),
    ],
)
def test_a_mistake_is_one_line(arguments, complaint, tmp_path, capsys):
    assert main(["surface", *arguments, f"out={tmp_path / 'out'}"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and complaint in error
    assert not (tmp_path / "out").exists()


def test_a_place_that_cannot_be_written_to_is_said_first(tmp_path, capsys):
    """A file where the folder's parent should be; said before the missing capture is."""
    (tmp_path / "file").write_text("")
    assert main(["surface", "capture=nowhere", f"out={tmp_path / 'file' / 'out'}"]) == 2
    assert "expected a place to write to" in capsys.readouterr().err


def test_darkness_is_said(optics, tmp_path, capsys):
    devices = {"cam1": Device(size=SIZE), "projector": Device(size=PROJECTOR)}
    black = np.zeros((9, SIZE[1], SIZE[0]), np.uint8)
    writer.write_surface(tmp_path / "capture", {"cam1": black}, SEQUENCES["centre_line"], optics, devices)
    assert main(["surface", f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'out'}"]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_real_relief(real, tmp_path):
    """A plaster relief under somebody else's projector: most of it, where it stood, and smooth."""
    source = real / "fringe_capture"
    fields = [f"images={source}", "patterns=twelve_step_gray", f"calibration={source / 'calibration.yml'}"]
    assert main(["surface", *fields, f"out={tmp_path / 'out'}"]) == 0
    with np.load(tmp_path / "out" / "points.npz") as file:
        depth = file["points"][..., 2]
    depth_known = depth[np.isfinite(depth)]
    assert depth_known.size >= 210_000
    low, high = np.percentile(depth_known, [0.1, 99.9])
    assert low > 690 and high < 780
    bends = (depth[:, :-2] - 2 * depth[:, 1:-1] + depth[:, 2:]) / np.sqrt(6)
    assert 1.4826 * np.nanmedian(np.abs(bends)) < 0.5, "scatter of neighbours, mm; the sequence's own noise is 0.35"


PAGE = (Path(__file__).parents[2] / "docs" / "captures.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, flags=re.M | re.S)


def test_the_page_names_every_field():
    for model, prefix in ((Manifest, ""), (Device, "devices.*."), (SurfacePart, "surface."), (SweepPart, "sweep.")):
        missing = {"devices", "day"} if model is SweepPart else set()  # described once, with `surface.devices`, `surface.day`
        for name, field in model.model_fields.items():
            assert name in missing or f"| `{prefix}{field.alias or name}` |" in PAGE


def test_the_manifests_of_the_page_are_valid():
    read = [Manifest.model_validate(json.loads(text)) for text in blocks("json")]
    assert [(content.surface is not None, sorted(content.sweep.images) if content.sweep else []) for content in read] == [
        (False, []),
        (False, ["us"]),
        (False, ["cam1", "cam2"]),
        (False, []),
        (True, []),
    ]


def commands(verb: str) -> list[list[str]]:
    lines = [shlex.split(line) for text in blocks("sh") for line in text.splitlines()]
    return [arguments[1:] for arguments in lines if arguments[:2] == ["sonotwin", verb]]


def test_the_page_is_run_whole():
    """Each of its commands is of a verb that one of the tests below runs, or of one with tests of its own."""
    verbs = ("surface", "track", "describe", "export")
    assert sum(len(commands(verb)) for verb in verbs) == sum(text.count("\n") for text in blocks("sh"))


def test_the_page_tracks(rig, tmp_path, monkeypatch):
    """The manifest of a film, with the frames that it names, by the command below it."""
    films.film(tmp_path / "session", rig, np.random.default_rng(4), count=2)
    (manifest,) = (text for text in blocks("json") if "sweep/cam2" in text)
    (tmp_path / "session" / "manifest.json").write_text(manifest, encoding="utf-8")
    stand_in = Told(films.centres(rig, films.places(1)[0]))
    monkeypatch.setattr(networks, "load", lambda *_: stand_in)
    monkeypatch.chdir(tmp_path)
    (command,) = commands("track")
    assert main(command) == 0
    assert json.loads(Path("tracked/metrics.json").read_text(encoding="utf-8"))["frames_found"] == 2


@pytest.mark.slow
def test_the_page_measures(rig, tmp_path, monkeypatch):
    """The manifest of a surface, the pattern file and their commands, in a folder that holds what the page talks about.

    Images have half the page's size.
    """
    optics = Calibration({"cam1": shrunk(rig.cam1, 2).optics.camera(), "projector": rig.projector.optics.camera()})
    size = optics.cameras["cam1"].size
    calibration_files.write(tmp_path / "optics.yaml", optics)
    (manifest,) = (json.loads(text) for text in blocks("json") if "surface" in json.loads(text))
    manifest["devices"]["cam1"]["size"] = size
    patterns = Patterns.model_validate(manifest["surface"]["patterns"])
    named = [tmp_path / "shots" / name for name in manifest["surface"]["images"]["cam1"]]
    (tmp_path / "wrapped").mkdir()
    (tmp_path / "wrapped" / "manifest.json").write_text(json.dumps(manifest))
    devices = {"cam1": Device(size=size), "projector": Device(size=(1280, 800))}
    pictures = photograph(patterns, optics)
    writer.write_surface(tmp_path / "capture", {"cam1": pictures}, patterns, optics, devices)
    paper = surface_part.read_patterns(Path(__file__).parents[2] / "conf" / "patterns" / "paper_surface.yaml")
    monkeypatch.chdir(tmp_path)

    assert len(commands("surface")) == 4
    for arguments in commands("surface"):
        shutil.rmtree("shots", ignore_errors=True)
        if "images=shots" in arguments:
            images.write_images([tmp_path / "shots" / f"{i}.png" for i in range(paper.count)], photograph(paper, optics))
        else:
            images.write_images(named, pictures)
        assert main(arguments) == 0
        assert json.loads(Path("surface/metrics.json").read_text(encoding="utf-8"))["points"] > 125_000

    text, of_gray_code = blocks("yaml")
    Path("sequence.yaml").write_text(text, encoding="utf-8")
    Path("gray_code.yaml").write_text(of_gray_code, encoding="utf-8")
    sequence = surface_part.read_patterns(Path("sequence.yaml"))
    assert surface_part.read_patterns(Path("gray_code.yaml")).count == 22
    shutil.rmtree("shots")
    images.write_images([tmp_path / "shots" / f"{i}.png" for i in range(sequence.count)], photograph(sequence, optics))
    assert main(["surface", "images=shots", "patterns=sequence.yaml", "calibration=optics.yaml", "out=surface"]) == 0


SINGLE_WAVE = '''
"""One wave over the whole axis: its phase alone is the coordinate."""

import numpy as np

from recon.model.patterns import Fringes, of_kind
from recon.structured_light.gray_code import Orders
from recon.structured_light.shots import Ordered, finest

WHOLE_IMAGE = False
ALONE = ()


def check(parts, axis):
    """Check that a wave covers the axis."""
    if len(of_kind(parts, Fringes, axis)) != 1:
        raise ValueError("parts: single_wave unwrapping expects one set of fringes")


def orders(shots, axis, sets, valid, light):
    """The whole turn that brings each phase nearest to the middle of the axis."""
    part, fringe = finest(sets)
    length = shots.patterns.length(axis)
    cycles = ((length - 1) / 2 - part.zero(length)) / part.pitch - fringe.phase / (2 * np.pi)
    order = np.rint(cycles).astype(np.int32)
    return Ordered(Orders(order, np.abs(cycles - order) < 0.5 - fringe.sigma), np.zeros(valid.shape, bool), {})
'''


def test_a_fourth_unwrapping_is_one_module(optics, tmp_path, monkeypatch, capsys):
    """It is found by its name in a sequence's file, checks the parts, and decodes: the plane stands where it is."""
    sequence = tmp_path / "wave.yaml"
    text = "projector_size: [640, 400]\nunwrap: single_wave\nparts: [{kind: fringes, pitch: 720, steps: 16}]\n"
    sequence.write_text(text)
    with pytest.raises(sonotwin.InputError, match="expected 'centre_line', 'gray' or 'heterodyne', found 'single_wave'"):
        sonotwin.read_patterns(sequence)
    added.add(monkeypatch, tmp_path / "ours", "recon.structured_light.fringe_orders", "single_wave", SINGLE_WAVE)
    patterns = sonotwin.read_patterns(sequence)
    devices = {"cam1": Device(size=SIZE, exposure_s=0.01), "projector": Device(size=PROJECTOR)}
    writer.write_surface(tmp_path / "capture", {"cam1": photograph(patterns, optics)}, patterns, optics, devices)
    assert main(["surface", f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'out'}"]) == 0
    assert "unwrap      single wave" in capsys.readouterr().out
    fit = primitives.fit_plane(trimesh.load(tmp_path / "out" / "surface.ply", process=False).vertices)
    assert np.linalg.norm(np.cross(fit.shape.normal, TILT[:3, 2])) < 0.02
    assert abs((fit.shape.point - TILT[:3, 3]) @ TILT[:3, 2]) < 0.3
    sequence.write_text(text.replace("parts: [", "parts: [{kind: fringes, pitch: 12, steps: 8}, "))
    with pytest.raises(sonotwin.InputError, match="single_wave unwrapping expects one set of fringes"):
        sonotwin.read_patterns(sequence)


ROWS = '''
"""A text with a row a device: its name, size, focal lengths and centre, coefficients, and its pose, row by row in metres."""

import numpy as np

from recon.capture import camera_dialects
from recon.capture.camera_dialects import MM, Stored


def recognises(content):
    """Whether the first words are those of the dialect."""
    return any(text.startswith("rows of devices") for text in content.texts().values())


def read(content, sizes):
    """All devices."""
    (text,) = content.texts().values()
    found = {}
    for line in text.splitlines()[1:]:
        name, *words = line.split()
        w, h, fx, fy, cx, cy, *rest = map(float, words)
        pose = np.vstack([np.reshape(rest[5:], (3, 4)) * [1, 1, 1, MM], [0, 0, 0, 1]])
        found[name] = Stored((int(w), int(h)), camera_dialects.pinhole(fx, fy, cx, cy), np.array(rest[:5]), pose)
    return camera_dialects.of_metres(content.path, found)


def write(folder, optics):
    """Write one file."""
    lines = ["rows of devices"]
    for name, device in optics.cameras.items():
        k = device.matrix
        pose = device.camera_from_world[:3] / [1, 1, 1, MM]
        numbers = [*device.size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], *device.distortion, *pose.ravel()]
        lines.append(" ".join([name, *(repr(float(number)) for number in numbers)]))
    (folder / "rig.rows").write_text(chr(10).join(lines))
    return ["rig.rows"]


def taken(optics):
    """All."""
    return list(optics.cameras)
'''


def test_another_dialect_of_calibrations_is_one_module(optics, tmp_path, monkeypatch, capsys):
    """`export` writes it by its name, `surface` reads it by its content, and the surface is that of the rig's own file."""
    devices = {"cam1": Device(size=SIZE, exposure_s=0.01), "projector": Device(size=PROJECTOR)}
    patterns, capture = SEQUENCES["gray"], tmp_path / "capture"
    writer.write_surface(capture, {"cam1": photograph(patterns, optics)}, patterns, optics, devices)
    export = ["export", "layout=rows", f"capture={capture}", f"out={tmp_path / 'theirs'}"]
    assert main(export) == 2
    names = "'meza2021', 'screen', 'us_calibration', 'kalibr', 'mrcal', 'ros' or 'slstudio'"
    assert f"{names}, found 'rows'" in capsys.readouterr().err
    added.add(monkeypatch, tmp_path / "ours", calibration_files.DIALECTS, "rows", ROWS)
    assert main(export) == 0
    theirs = tmp_path / "theirs" / "rig.rows"
    for name, given in {"a": [], "b": [f"calibration={theirs}"]}.items():
        assert main(["surface", f"capture={capture}", f"out={tmp_path / name}", *given]) == 0
    with np.load(tmp_path / "a" / "points.npz") as own, np.load(tmp_path / "b" / "points.npz") as other:
        assert np.allclose(own["points"], other["points"], atol=1e-3, equal_nan=True)
    theirs.write_text("%YAML:1.0\n---\nA: 1\n", encoding="utf-8")
    assert main(["surface", f"capture={capture}", f"calibration={theirs}", f"out={tmp_path / 'c'}"]) == 2
    assert "or a file of ROS, or a file of rows, or M1" in capsys.readouterr().err
