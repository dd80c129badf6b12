"""`sonotwin segment`, from a sweep to closed surfaces in the world."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter

import sonotwin
from recon.capture import sweep_part
from recon.files import volumes
from recon.freehand import sequences
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from recon.segmentation import seen_map
from sonotwin.cli import main
from tests.recon import captures, probe_motions, sweep_sets

LAG_S = 0.1
SIZE, SCALE = (90, 100), np.array([0.35, 0.35])  # px, mm/px: 31.5 x 35 mm
CENTRE, RADIUS = np.array([12.0, -8.0, 700.0]), 5.0
DARK = 0.04  # of tissue's power


@pytest.fixture(scope="module")
def capture(tmp_path_factory, rig) -> Path:
    """A sweep at 10 mm/s, along y, across a dark ball in speckle, 16 mm deep."""
    folder = tmp_path_factory.mktemp("mass") / "capture"
    rng = np.random.default_rng(3)
    probe = ProbeCalibration(rig.probe.target_from_image.matrix(), SCALE)
    turn = probe_motions.LOOKING_AWAY
    place = turn[:, 0] * SCALE[0] * SIZE[0] / 2 + turn[:, 1] * 16.0

    def world_from_image(t: float) -> np.ndarray:
        return rigid.transform(turn, CENTRE - place + turn[:, 2] * 10 * t)

    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    plane = np.stack([u * SCALE[0], v * SCALE[1], 0 * u], axis=-1)

    def image(t: float) -> np.ndarray:
        distance = np.linalg.norm(rigid.apply(world_from_image(t), plane) - CENTRE, axis=-1)
        field = rng.normal(size=(2, *distance.shape)) * np.where(distance < RADIUS, np.sqrt(DARK), 1.0)
        power = (gaussian_filter(field, (0, 0.5, 0.7)) ** 2).sum(axis=0) * 4 * np.pi * 0.35
        return np.rint(np.clip(255 * (1 + (10 * np.log10(power + 1e-9) - 28) / 60), 0, 255)).astype(np.uint8)

    moments, tracked = np.arange(-1.2, 1.2, 0.05), np.arange(-1.3, 1.3, 0.025)
    poses = np.array([world_from_image(t) @ rigid.invert(probe.target_from_image) for t in tracked])
    times, track = sweep_sets.nanoseconds(moments + LAG_S), Track(sweep_sets.nanoseconds(tracked), poses)
    captures.write_sweep(folder, (image(t) for t in moments), times, track, SIZE, probe, "mass")
    return folder


@pytest.fixture(scope="module")
def segmented(capture) -> Path:
    out = capture.parent / "masses"
    plane = trimesh.creation.box((80, 80, 1)).apply_translation([12, -8, 685.5])
    front = plane.submesh([np.flatnonzero(plane.face_normals[:, 2] < -0.9)], append=True)
    front = front.subdivide().subdivide().subdivide().subdivide()
    front.export(capture.parent / "skin.ply")
    assert main(["segment", f"capture={capture}", f"lag_s={LAG_S}", f"surface={capture.parent / 'skin.ply'}", f"out={out}"]) == 0
    return out


def test_the_mass_is_where_it_is_and_as_large(segmented):
    """Speckle of 1100 mm2 of border views leaves some per cent; the skin is a plane 15 mm before its middle."""
    figures = json.loads((segmented / "metrics.json").read_text())
    assert figures["masses"] == 1
    assert figures["mass0_volume_mm3"] == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.08)
    centre = [figures[f"mass0_centre_{axis}_mm"] for axis in "xyz"]
    assert np.linalg.norm(centre - CENTRE) < 0.25
    assert 80 < figures["tissue_grey"] < 180 and figures["speed_m_per_s"] == 1540
    assert figures["mass0_inside"] == 1 and figures["mass0_covered"] == 1
    assert figures["mass0_depth_mm"] == pytest.approx(15 - RADIUS, abs=0.6)


def test_the_interface_gives_the_verbs_mass(capture, segmented):
    """From B-scans and poses in memory, with the blur that the verb corrects for."""
    sweep = sonotwin.read_sweep(capture)
    scans, target_from_pixel = list(sweep.images()), sweep.probe.target_from_image @ np.diag([*sweep.probe.scale, 1, 1])
    placed = sweep.poses(LAG_S) @ target_from_pixel  # in the verb's order: rounding decides on pixels at voxels' borders
    (mass,) = sonotwin.find_masses(lambda: iter(scans), SIZE[::-1], placed, sonotwin.Sound(), blur=sonotwin.Blur()).masses
    figures = json.loads((segmented / "metrics.json").read_text())
    assert mass.volume == pytest.approx(figures["mass0_volume_mm3"], rel=1e-6)
    assert np.allclose(mass.centre, [figures[f"mass0_centre_{axis}_mm"] for axis in "xyz"], atol=1e-6)


def test_a_sequence_of_a_screen_shows_the_same_mass(capture, segmented, tmp_path):
    """As PLUS records it, late and uncropped, with the calibration in its configuration: as of the capture's own B-scans."""
    probe = sweep_part.read_sweep(capture).probe
    path = sweep_sets.recorded(tmp_path / "mass.igs.mha", capture, screen=True)
    across, above = sweep_sets.BORDER
    on_screen = sequences.target_from_pixel(probe) @ rigid.transform(np.eye(3), [-across, -above, 0])
    text = " ".join(map(repr, on_screen.ravel().tolist()))
    (tmp_path / "plus.xml").write_text(
        f'<PlusConfiguration><CoordinateDefinitions><Transform From="Screen" To="Probe" Matrix="{text}"/></CoordinateDefinitions>'
        "</PlusConfiguration>"
    )
    source = [f"sequence={path}", f"config={tmp_path / 'plus.xml'}", "image=Screen", "reference=Tracker", f"lag_s={LAG_S}"]
    clip = f"clip=[{across},{above},{SIZE[0]},{SIZE[1]}]"
    assert main(["segment", *source, clip, f"out={tmp_path / 'out'}"]) == 0
    ours, theirs = (json.loads((folder / "metrics.json").read_text()) for folder in (segmented, tmp_path / "out"))
    assert theirs["masses"] == 1 and theirs["mass0_volume_mm3"] == pytest.approx(ours["mass0_volume_mm3"], rel=0.02)
    for axis in "xyz":
        assert theirs[f"mass0_centre_{axis}_mm"] == pytest.approx(ours[f"mass0_centre_{axis}_mm"], abs=0.1)


def test_a_clip_of_a_capture_keeps_the_mass_in_its_place(capture, segmented, tmp_path):
    """Cut by 8 columns and 12 rows, over the tissue beside the mass."""
    clip = f"clip=[8,12,{SIZE[0] - 16},{SIZE[1] - 20}]"
    assert main(["segment", f"capture={capture}", f"lag_s={LAG_S}", clip, f"out={tmp_path / 'out'}"]) == 0
    ours, cut = (json.loads((folder / "metrics.json").read_text()) for folder in (segmented, tmp_path / "out"))
    for axis in "xyz":
        assert cut[f"mass0_centre_{axis}_mm"] == pytest.approx(ours[f"mass0_centre_{axis}_mm"], abs=0.1)


def test_files(segmented):
    names = {path.name for path in segmented.iterdir()}
    assert {"mass0.ply", "mass0.glb", "metrics.json", "overlay0.png"} <= names
    mesh = trimesh.load_mesh(segmented / "mass0.ply")
    figures = json.loads((segmented / "metrics.json").read_text())
    assert mesh.is_watertight and mesh.volume == pytest.approx(figures["mass0_volume_mm3"], rel=1e-3)


def test_the_map_of_what_was_seen_holds_the_mass(segmented):
    """A mass would have been found where one was, not at the images' side, nor where it would stand out of the skin."""
    seen, figures = seen_map.read(segmented), json.loads((segmented / "metrics.json").read_text())
    volume = volumes.read_volume(seen.volume)
    places = CENTRE + np.array([[0, 0, 0], [15, 0, 0], [0, 0, -13]])
    i, j, k = np.rint(rigid.apply(np.linalg.inv(volume.world_from_voxel), places)).astype(int).T
    there, beside, above = volume.voxels[k, j, i]
    assert there > 0.7 and 0 <= beside < 0.35 and above == seen_map.OUTSIDE
    assert figures["seen_mm3"] > 1000 and figures["unseen_mm3"] > 1000 and seen.unseen.is_watertight


def test_what_is_wrong_is_said_in_one_line_and_nothing_is_written(capture, tmp_path, capsys):
    out = tmp_path / "out"

    def complaint(*fields: str) -> str:
        assert main(["segment", f"out={out}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    assert complaint() == "segment: expected capture or sequence, found neither"
    assert complaint(f"capture={capture}", f"surface={tmp_path / 'a.ply'}").endswith(
        "a.ply: expected a surface as PLY, found none"
    )
    (tmp_path / "b.ply").write_bytes(b"ply\nformat")
    assert f"{tmp_path / 'b.ply'}: expected a surface" in complaint(f"capture={capture}", f"surface={tmp_path / 'b.ply'}")
    (tmp_path / "c.stl").write_bytes(b"solid")
    assert complaint(f"capture={capture}", f"surface={tmp_path / 'c.stl'}").endswith("expected a surface as PLY, found .stl")
    assert complaint(f"capture={capture}", "config=a.xml").startswith("segment: config: expected a configuration with a seq")
    assert complaint(f"capture={capture}", "reference=Tracker").startswith("segment: reference: expected none without a seq")
    assert complaint(f"capture={capture}", "lag_s=1e9").startswith("segment: lag_s: expected ")
    assert complaint(f"capture={capture}", "tissue_m_s=1").startswith("segment: tissue_m_s: expected ")
    assert complaint(f"capture={capture}", "diameter_mm=[9,5]").startswith("segment: diameter_mm: expected the least before")
    assert complaint(f"capture={capture}", "kind=tube").startswith(f"{capture}: rings: expected at least three images")
    assert not out.exists()


def test_lobes_are_corrected_for_blur_unless_it_is_unknown(capture, tmp_path, capsys):
    """A larger blur flattens more, so more is given back; null leaves the border as it was found."""
    volumes = {}
    for name, blur in (("none", "null"), ("thin", "[]"), ("thick", "[[5,0.9]]")):
        fields = [f"capture={capture}", f"lag_s={LAG_S}", f"slice_mm={blur}", f"out={tmp_path / name}"]
        assert main(["segment", *fields]) == 0
        volumes[name] = json.loads((tmp_path / name / "metrics.json").read_text())["mass0_volume_mm3"]
        assert ("lobes are corrected" in capsys.readouterr().out) == (name != "none")
    assert volumes["thick"] > volumes["thin"] * 1.005 and volumes["none"] != volumes["thin"]


@pytest.mark.parametrize(("slices", "said"), [("[[8,0.5],[8,0.4]]", "slice_mm: expected rising depths"), ("[[8,3]]", "1.2")])
def test_a_slice_that_cannot_be_is_refused(capture, tmp_path, capsys, slices, said):
    assert main(["segment", f"capture={capture}", f"slice_mm={slices}", f"out={tmp_path / 'out'}"]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()
