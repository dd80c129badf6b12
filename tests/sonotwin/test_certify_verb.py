"""`sonotwin certify`: from meshes of any scanner and from rendered captures to a certificate; mistakes are refused in a line."""

import json

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recon.acceptance import prescribed_places
from recon.acceptance.certificates import Volume
from recon.capture import sweep_tables, tip_files
from recon.files import meshes
from recon.geometry import rigid
from recon.model.tip import Tip
from recon.model.tracks import Track
from sonotwin.choices import read_rig
from sonotwin.cli import main
from tests.recon.acceptance import drawn_surfaces
from tests.twin.small_rigs import half_as_fields

SIGMA = 0.01
FILES = {"certificate.html", "certificate.pdf", "certificate.json"}


def write(path, points):
    """A mesh of points : (3 n, 3), each in one triangle."""
    path.parent.mkdir(parents=True, exist_ok=True)
    points = points[: len(points) // 3 * 3]
    meshes.write_ply(path, trimesh.Trimesh(points, np.arange(len(points)).reshape(-1, 3), process=False))


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """Meshes of all artefacts in two places each, by a scanner with a little noise."""
    folder, rng, volume = tmp_path_factory.mktemp("scanned"), np.random.default_rng(5), Volume()
    for k, centre in enumerate(prescribed_places.spheres(volume, 39.6)[:2]):
        write(folder / f"sphere/{k:02d}.ply", drawn_surfaces.ball(centre, 19.8, rng, SIGMA, 800))
    for k, (middle, along) in enumerate(zip(*(part[:2] for part in prescribed_places.bars(volume, 150, 38.1)), strict=True)):
        ends = (middle - 75 * along, middle + 75 * along)
        balls = [drawn_surfaces.ball(end, 19.05, rng, SIGMA, 800) for end in ends]
        write(folder / f"bar/{k:02d}.ply", np.concatenate([*balls, drawn_surfaces.rod(*ends, 4.0, rng)]))
    for k in range(2):
        write(folder / f"plane/{k:02d}.ply", drawn_surfaces.plate((4, -2, 640 + 30 * k), (220, 170), rng, SIGMA))
    return folder


def certify(scanned, out, *fields):
    return main(["certify", f"capture={scanned}", f"out={out}", *fields])


def test_meshes_are_certified(scanned, tmp_path, capsys):
    """A good scanner is accepted, and what the arrangement lacks is told; the record has each value with its budget."""
    out = tmp_path / "out"
    assert certify(scanned, out, "operator=A. Meter") == 0
    said = capsys.readouterr().out
    assert "verdict     Accepted: all 14 test values keep to their limits" in said and "demand      sphere: 10 places" in said
    assert {path.name for path in out.iterdir()} >= FILES
    record = json.loads((out / "certificate.json").read_text())
    assert record["decision"] == "accepted" and len(record["values"]) == 14
    for value in record["values"]:
        assert sum(row["share"] for row in value["budget"]) == pytest.approx(1)
        assert value["standard_uncertainty_mm"] < 0.02 and value["decision"] == "accepted"
    assert "A. Meter" in (out / "certificate.html").read_text()


def test_stricter_limits_decide_otherwise(scanned, tmp_path):
    """Noise of 0.01 mm makes a form error of 0.06 mm: rejected at 0.03."""
    assert certify(scanned, tmp_path / "strict", "limits.pf_mm=0.03") == 1
    assert json.loads((tmp_path / "strict/certificate.json").read_text())["decision"] == "rejected"


def test_without_limits_values_are_reported(scanned, tmp_path):
    none = [f"limits.{name}_mm=null" for name in ("pf", "pf95", "ps", "sd", "e", "f", "f95")]
    assert certify(scanned, tmp_path / "none", *none) == 0
    record = json.loads((tmp_path / "none/certificate.json").read_text())
    assert {value["decision"] for value in record["values"]} == {None}


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        (
            ["capture=FOLDER/sphere"],
            "sphere/sphere: expected a folder with a capture or mesh for each place, such as 00, found none",
        ),
        (["artefacts.sphere.diameter.mm=60"], "sphere/00.ply: expected 1 ball of 60 mm, found "),
        (["artefacts.bar.length.mm=100"], "bar/00.ply: expected balls 100 mm apart, found some 150.0"),
        (["artefacts.bar.length.mm=30"], "artefacts.bar.length.mm: expected more than its balls' diameters, found 30"),
        (["artefacts.bar.rod_mm=40"], "artefacts.bar.rod_mm: expected less than its balls' diameters, found 40"),
        (
            ["artefacts.sphere=null", "artefacts.bar=null", "artefacts.plane=null"],
            "artefacts: expected sphere, bar, plane, divots or filaments, found none of them",
        ),
        (["limits.sd_mm=-1"], "limits.sd_mm: expected"),
        (["artefacts=glass"], "artefacts: expected one of divot_plate, filaments, steel"),
    ],
)
def test_mistakes_are_refused(scanned, tmp_path, capsys, fields, complaint):
    given = [field.replace("FOLDER", str(scanned)) for field in fields]
    assert certify(scanned, tmp_path / "out", *given) == 2
    error = capsys.readouterr().err
    assert complaint in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_artefacts_that_are_left_out_are_not_needed(scanned, tmp_path, capsys):
    assert certify(scanned, tmp_path / "out", "artefacts.bar=null", "artefacts.plane=null") == 0
    record = json.loads((tmp_path / "out/certificate.json").read_text())
    assert {value["quantity"] for value in record["values"]} == {"PF", "PF95", "PS"}


@pytest.mark.slow
def test_a_rendered_bar_is_certified(tmp_path, capsys):
    """In seven places, by cameras of half the size: all demands are met, and lengths are right to 0.01 mm, 1.5 U."""
    small = [*half_as_fields(read_rig()), "tracing.samples=2"]
    alone = ["artefacts.sphere=null", "artefacts.plane=null"]
    assert main(["render-artefacts", *small, *alone, f"out={tmp_path / 'in'}"]) == 0
    assert sorted(path.name for path in (tmp_path / "in/bar").iterdir()) == [f"{k:02d}" for k in range(7)]
    assert main(["certify", *alone, f"capture={tmp_path / 'in'}", f"out={tmp_path / 'out'}"]) in (0, 1)
    values = json.loads((tmp_path / "out/certificate.json").read_text())["values"]
    spacings = [one for one in values if one["quantity"] == "SD"]
    assert len(spacings) == 7
    assert all(abs(one["value_mm"]) < 0.01 for one in spacings), spacings
    assert "demand" not in capsys.readouterr().out


PLATE = ["artefacts=divot_plate", "tip=TOOL/tip.yaml"]


@pytest.fixture
def tool(tmp_path):
    """Poses of a tool that turns in three divots of the plate, drawn with 0.05 mm of noise, and its tip."""
    rng, tip = np.random.default_rng(3), np.array([0.0, -120.0, -30.0])
    for k, place in enumerate([(0, 0, 650), (80, 0, 650), (0, 60, 650)]):
        turns = Rotation.from_euler("xyz", rng.uniform(-15, 15, (60, 3)), degrees=True).as_matrix()
        origins = place - turns @ tip + 0.05 * rng.standard_normal((60, 3))
        poses = np.array([rigid.transform(turn, origin) for turn, origin in zip(turns, origins, strict=True)])
        (tmp_path / f"tool/divots/{k:02d}").mkdir(parents=True)
        sweep_tables.write_track(tmp_path / f"tool/divots/{k:02d}/poses.csv", Track(np.arange(60) * 10**8, poses))
    tip_files.write(tmp_path / "tool/tip.yaml", Tip(tip, 0.01 * np.eye(3)))
    return tmp_path / "tool"


def test_a_tracked_tool_is_certified(tool, tmp_path):
    """In three divots, with three distances; noise of 0.05 mm along each axis is 0.087 RMS."""
    assert certify(tool, tmp_path / "out", *[field.replace("TOOL", str(tool)) for field in PLATE], "limits.td_mm=0.15") == 0
    values = json.loads((tmp_path / "out/certificate.json").read_text())["values"]
    assert [one["quantity"] for one in values] == ["TP"] * 3 + ["TD"] * 3
    assert all(one["value_mm"] == pytest.approx(0.087, rel=0.3) for one in values[:3])
    assert all(abs(one["value_mm"]) < one["expanded_uncertainty_mm"] and one["decision"] == "accepted" for one in values[3:])


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        (["artefacts=divot_plate"], "tip: expected the tip.yaml of the tool in the divots, found none"),
        (
            [*PLATE, "artefacts.divots.places_mm=[[0,0,0],[80,0,0]]"],
            "divots/02: expected a name that begins with a divot's number, 00 to 01",
        ),
        ([*PLATE, "artefacts.divots.places_mm=[[0,0,0],[0,0,0]]"], "expected places apart from each other, found 0 and 1"),
        ([*PLATE, "capture=TOOL/divots"], "divots/divots: expected a folder with a table of poses for each divot"),
    ],
)
def test_mistakes_about_a_tool_are_refused(tool, tmp_path, capsys, fields, complaint):
    assert certify(tool, tmp_path / "out", *[field.replace("TOOL", str(tool)) for field in fields]) == 2
    error = capsys.readouterr().err
    assert complaint in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_scanner_is_certified_by_rendered_filaments(tmp_path, capsys):
    """What isn't measured is said; the record has callipers and widths."""
    small = ["artefacts=filaments", "artefacts.filaments.places_mm=[[0,10],[0,20],[0,30],[10,20],[11,20]]"]
    assert main(["render-artefacts", *small, f"out={tmp_path / 'scanner'}"]) == 0
    assert len(list((tmp_path / "scanner/filaments/00").glob("*.png"))) == 5
    limits = ["limits.ud_mm=0.3", "limits.ul_mm=1.2", "limits.ua_mm=0.3"]
    assert certify(tmp_path / "scanner", tmp_path / "out", *small, *limits) == 0
    assert "filaments/00: no widths of filaments 3, 4: clipped, so lower the gain, or near another one" in capsys.readouterr().out
    values = json.loads((tmp_path / "out/certificate.json").read_text())["values"]
    assert {one["quantity"] for one in values} == {"UD", "UL", "UA"}
    assert all(abs(one["value_mm"]) < one["expanded_uncertainty_mm"] for one in values if one["quantity"] == "UD")


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: [path.unlink() for path in list(folder.glob("*.png"))[2:]], "filaments/00: expected 3 B-scans or more"),
        (lambda folder: (folder / "b.png").write_bytes(b"no"), "b.png: "),
        (lambda folder: cv2.imwrite(str(folder / "c.png"), np.zeros((9, 9), np.uint8)), "c.png: expected 40x50"),
    ],
)
def test_b_scans_that_cant_be_are_refused(spoil, said, tmp_path, capsys):
    folder = tmp_path / "scanner/filaments/00"
    folder.mkdir(parents=True)
    for k in range(4):
        cv2.imwrite(str(folder / f"a{k}.png"), np.zeros((50, 40), np.uint8))
    spoil(folder)
    assert certify(tmp_path / "scanner", tmp_path / "out", "artefacts=filaments") == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()
