"""`sonotwin freehand`, from a sweep or a sequence of the PLUS toolkit to a volume."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sonotwin
from recon.capture import probe_files, sweep_part
from recon.files import volumes
from recon.freehand import sequences
from recon.freehand.sequences import Frames
from recon.geometry import rigid
from sonotwin.cli import main
from tests.recon import sweep_sets

LAG_S = 0.2
PLUS = """<PlusConfiguration version="2.1">
  <VolumeReconstruction OutputSpacing="0.8 0.8 0.8" Interpolation="NEAREST_NEIGHBOR" CompoundingMode="MAXIMUM" FillHoles="OFF"/>
</PlusConfiguration>
"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory, rig) -> Path:
    return sweep_sets.ball(tmp_path_factory.mktemp("ball") / "capture", rig, LAG_S)


@pytest.fixture(scope="module")
def reconstructed(capture) -> Path:
    out = capture.parent / "volume"
    assert main(["freehand", f"capture={capture}", f"lag_s={LAG_S}", f"out={out}"]) == 0
    return out


def ball_of(path: Path) -> tuple[np.ndarray, float]:
    """Centre and volume (mm, mm^3) of what is bright."""
    volume = volumes.read_volume(path)
    k, j, i = np.nonzero(volume.voxels > 110)
    corners = np.column_stack([i, j, k, np.ones(len(i))]) @ volume.world_from_voxel.T
    return corners[:, :3].mean(axis=0), len(i) * float(np.prod(volume.spacing))


BALL_MM3 = 4 / 3 * np.pi * sweep_sets.BALL_MM**3


def test_the_interface_gives_the_verbs_volume(capture, reconstructed):
    """From B-scans and poses in memory."""
    sweep = sonotwin.read_sweep(capture)
    width, height = sweep.size
    target_from_pixel = sweep.probe.target_from_image @ np.diag([*sweep.probe.scale, 1, 1])
    placed = sweep.poses(LAG_S) @ target_from_pixel  # in the verb's order: rounding decides on pixels at voxels' borders
    corners = np.array([[u, v, 0, 1] for u in (0, width - 1) for v in (0, height - 1)])
    around = (corners @ placed[np.isfinite(placed).all(axis=(1, 2))].transpose(0, 2, 1))[..., :3].reshape(-1, 3)
    made = sonotwin.fill_holes(sonotwin.reconstruct_volume(sweep.images(), placed, sonotwin.principal_grid(around, 0.5))).volume
    written = volumes.read_volume(reconstructed / "volume.nrrd")
    assert np.array_equal(made.voxels, written.voxels) and np.allclose(made.origin, written.origin, atol=1e-6)


def test_the_ball_is_where_it_is_and_as_large(reconstructed):
    """Within a half voxel; 905 mm^3 within 5 %, its surface being 452 mm^2 and half-filled voxels counting either way."""
    centre, content = ball_of(reconstructed / "volume.nrrd")
    assert np.linalg.norm(centre - sweep_sets.BALL) < 0.25
    assert content == pytest.approx(BALL_MM3, rel=0.05)
    figures = json.loads((reconstructed / "metrics.json").read_text())
    assert (figures["frames"], figures["frames_placed"]) == (41, 41)
    assert 0 < figures["pasted_fraction"] <= figures["filled_fraction"] <= 1


def test_a_lag_that_is_not_told_moves_the_ball(capture, reconstructed, tmp_path):
    """The probe moves at 10 mm/s, so that 0.2 s are 2 mm along the sweep."""
    assert main(["freehand", f"capture={capture}", f"out={tmp_path / 'out'}"]) == 0
    away = ball_of(tmp_path / "out" / "volume.nrrd")[0] - ball_of(reconstructed / "volume.nrrd")[0]
    assert np.linalg.norm(away) == pytest.approx(10 * LAG_S, abs=0.3)


def test_the_sequence_is_the_sweep_for_slicer(capture, reconstructed, rig):
    """Images, poses and times, by which PLUS would put the B-scans where they are put here."""
    frames = sequences.read_sequence(reconstructed / "sequence.igs.mha")
    sweep = sweep_part.read_sweep(capture)
    np.testing.assert_array_equal(frames.images, np.stack(list(sweep.images())))
    ours = sweep.poses(LAG_S) @ sequences.target_from_pixel(sweep.probe)
    np.testing.assert_allclose(sequences.poses(frames, "Reference", "Image"), ours, atol=1e-9)
    np.testing.assert_allclose(np.diff(frames.times_s), 0.05, atol=1e-6)
    names = [".sonotwin.json", "metrics.json", "sequence.igs.mha", "volume.nrrd"]  # no sigma.nrrd: the poses have no covariance
    assert sorted(path.name for path in reconstructed.iterdir()) == names


def test_a_sequence_gives_the_same_volume(reconstructed, tmp_path):
    assert main(["freehand", f"sequence={reconstructed / 'sequence.igs.mha'}", f"out={tmp_path / 'out'}"]) == 0
    ours, theirs = (volumes.read_volume(folder / "volume.nrrd") for folder in (reconstructed, tmp_path / "out"))
    np.testing.assert_array_equal(ours.voxels, theirs.voxels)
    np.testing.assert_allclose(ours.origin, theirs.origin, atol=1e-9)
    assert not (tmp_path / "out" / "sequence.igs.mha").exists()


def test_anothers_sequence_is_said_to_lie_elsewhere_in_slicer_and_lps_mends_it(reconstructed, tmp_path, capsys):
    """With a ReferenceToRas that moves by 50 mm and doesn't turn: LPS is half a turn from there."""
    frames = sequences.read_sequence(reconstructed / "sequence.igs.mha")
    ras_from_reference = rigid.transform(np.eye(3), [50, 0, 0])
    others = {name: frames.transforms[name] for name in ("ImageToProbe", "ProbeToTracker", "ReferenceToTracker")}
    others["ReferenceToRas"] = np.tile(ras_from_reference, (len(frames.times_s), 1, 1))
    valid = dict.fromkeys((*others, "Image"), frames.valid["ProbeToTracker"])
    sequences.write_sequence(tmp_path / "s.igs.mha", Frames(frames.times_s, others, valid, frames.images))
    fields = ["freehand", f"sequence={tmp_path / 's.igs.mha'}", f"out={tmp_path / 'out'}"]
    assert main(fields) == 0
    assert "warning     3D Slicer shows the sequence where its transforms to RAS put it" in capsys.readouterr().out
    assert np.linalg.norm(ball_of(tmp_path / "out" / "volume.nrrd")[0] - sweep_sets.BALL) < 0.3
    assert main([*fields, "reference=LPS"]) == 0
    assert "warning" not in capsys.readouterr().out
    expected = np.add(sweep_sets.BALL, (50, 0, 0)) * (-1, -1, 1)
    assert np.linalg.norm(ball_of(tmp_path / "out" / "volume.nrrd")[0] - expected) < 0.3
    assert main([*fields, "reference=RAS"]) == 2
    assert "s.igs.mha: reference: expected LPS, which files of volumes" in capsys.readouterr().err


def test_a_sequence_by_the_configuration_of_plus(reconstructed, tmp_path, capsys):
    (tmp_path / "plus.xml").write_text(PLUS)
    fields = [f"sequence={reconstructed / 'sequence.igs.mha'}", f"config={tmp_path / 'plus.xml'}", f"out={tmp_path / 'out'}"]
    assert main(["freehand", *fields]) == 0
    volume = volumes.read_volume(tmp_path / "out" / "volume.nrrd")
    np.testing.assert_allclose(volume.spacing, 0.8)
    np.testing.assert_allclose(volume.directions, np.eye(3), atol=1e-12)
    assert np.linalg.norm(ball_of(tmp_path / "out" / "volume.nrrd")[0] - sweep_sets.BALL) < 0.4
    assert "voxels of 0.8 mm, aligned, maximum, nearest by " in capsys.readouterr().out


def test_what_is_given_wins_over_a_configuration(reconstructed, tmp_path, capsys):
    """Each field by itself; what isn't given stays the configuration's: here holes, which it leaves open."""
    (tmp_path / "plus.xml").write_text(PLUS)
    source = [f"sequence={reconstructed / 'sequence.igs.mha'}", f"config={tmp_path / 'plus.xml'}", f"out={tmp_path / 'out'}"]
    assert main(["freehand", *source, "spacing_mm=1.5", "compounding=mean", "clip=[20,20,40,60]", "extent=principal"]) == 0
    said = capsys.readouterr().out
    assert "voxels of 1.5 mm, principal, mean, nearest by " in said
    assert "plus.xml but for spacing_mm, extent, compounding, clip, rounded at each pixel as in PLUS, darker" in said
    volume = volumes.read_volume(tmp_path / "out" / "volume.nrrd")
    np.testing.assert_allclose(volume.spacing, 1.5)
    assert np.abs(volume.directions - np.eye(3)).max() > 0.1
    assert set(np.unique(volume.voxels)) - {0, 20, 200}, "means, where the maximum has two levels"
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["pasted_fraction"] == figures["filled_fraction"]
    assert main(["freehand", *source, "hole_voxels=9", "tissue_m_s=1450"]) == 0
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["speed_m_per_s"] == 1450 and figures["filled_fraction"] >= figures["pasted_fraction"]


def test_a_fan_of_ones_own_goes_before_that_of_a_configuration(reconstructed, tmp_path, capsys):
    """One that no image reaches is refused; a setting that is no fan, by its name."""
    (tmp_path / "fan.xml").write_text(PLUS.replace("Interp", 'FanAnglesDeg="-35 35" FanOriginPixel="9999 0" Interp'))
    source = [f"sequence={reconstructed / 'sequence.igs.mha'}", f"config={tmp_path / 'fan.xml'}", f"out={tmp_path / 'out'}"]
    assert main(["freehand", *source]) == 2
    assert "fan: expected a part of an image of" in capsys.readouterr().err
    assert main(["freehand", *source, "fan=none"]) == 0
    capsys.readouterr()
    assert main(["freehand", *source, "fan=[160,-20,30,400,-45,45]"]) == 0
    assert "but for fan: " in capsys.readouterr().out
    assert main(["freehand", *source, "fan=[160,-20,30,400,-45,45]", "tissue_m_s=1450"]) == 2
    assert "tissue_m_s: expected none with a fan, whose lines run to all sides" in capsys.readouterr().err
    for wrong, message in (("[1,2,3]", "fan: expected find, none or [u,v,first,last,left,right], found [1, 2, 3]"),
                           ("[1,2,9,3,0,1]", "fan.radii: expected two, the less one first, found 9 and 3 px")):  # fmt: skip
        assert main(["freehand", *source, f"fan={wrong}"]) == 2
        assert message in capsys.readouterr().err


def test_a_calibration_wins_over_that_of_a_configuration_and_of_the_sequence(capture, reconstructed, tmp_path):
    """Theirs are 3 mm too deep; the configuration has no element for the volume, so that is as usual."""
    probe = sweep_part.read_sweep(capture).probe
    deeper = probe.target_from_image.copy()
    deeper[:3, 3] += 3 * deeper[:3, 1]
    wrong = sequences.target_from_pixel(type(probe)(deeper, probe.scale))
    text = " ".join(map(repr, wrong.ravel().tolist()))
    (tmp_path / "plus.xml").write_text(
        f'<PlusConfiguration><CoordinateDefinitions><Transform From="Image" To="Probe" Matrix="{text}"/></CoordinateDefinitions>'
        "</PlusConfiguration>"
    )
    source = [f"sequence={reconstructed / 'sequence.igs.mha'}", f"config={tmp_path / 'plus.xml'}"]
    assert main(["freehand", *source, f"out={tmp_path / 'wrong'}"]) == 0
    right, away = ball_of(reconstructed / "volume.nrrd")[0], ball_of(tmp_path / "wrong" / "volume.nrrd")[0]
    assert np.linalg.norm(away - right) == pytest.approx(3, abs=0.1), "the configuration's before the sequence's"
    probe_files.write(tmp_path / "probe.yaml", probe)
    assert main(["freehand", *source, f"probe={tmp_path / 'probe.yaml'}", f"out={tmp_path / 'right'}"]) == 0
    assert np.linalg.norm(ball_of(tmp_path / "right" / "volume.nrrd")[0] - right) < 0.05


def test_a_late_sequence_in_the_trackers_frame(capture, reconstructed, tmp_path):
    """As PLUS records it, poses at the late stamps of the images: the lag puts the ball where the capture does."""
    path = sweep_sets.recorded(tmp_path / "s.igs.nrrd", capture, sweep_part.read_sweep(capture).probe)
    assert main(["freehand", f"sequence={path}", "reference=Tracker", f"lag_s={LAG_S}", f"out={tmp_path / 'out'}"]) == 0
    assert np.linalg.norm(ball_of(tmp_path / "out" / "volume.nrrd")[0] - ball_of(reconstructed / "volume.nrrd")[0]) < 0.05


def test_fields_of_the_volume(capture, tmp_path, capsys):
    """Along the world's axes, coarser, of a part of each image around the ball, with holes left open."""
    fields = ["extent=aligned", "spacing_mm=1", "clip=[20,20,40,60]", "hole_voxels=0", "compounding=maximum"]
    assert main(["freehand", f"capture={capture}", f"lag_s={LAG_S}", f"out={tmp_path / 'out'}", *fields]) == 0
    volume = volumes.read_volume(tmp_path / "out" / "volume.nrrd")
    np.testing.assert_allclose(volume.spacing, 1.0)
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["pasted_fraction"] == figures["filled_fraction"]
    # 39 px by 59 px of 0.49 mm, tilted by 20 degrees: 27.9 and 33.8 mm along x and z; 20 mm of sweep along y
    assert volume.voxels.shape[::-1] == (29, 21, 35) and set(np.unique(volume.voxels)) == {0, 20, 200}
    assert "aligned, maximum, nearest" in capsys.readouterr().out


def test_another_calibration_takes_the_place_of_the_captures(capture, reconstructed, rig, tmp_path):
    """Moved by 3 mm along the depth, it moves the ball as far."""
    probe = sweep_part.read_sweep(capture).probe
    moved = probe.target_from_image.copy()
    moved[:3, 3] += 3 * moved[:3, 1]
    probe_files.write(tmp_path / "probe.yaml", type(probe)(moved, probe.scale))
    fields = [f"capture={capture}", f"lag_s={LAG_S}", f"probe={tmp_path / 'probe.yaml'}", f"out={tmp_path / 'out'}"]
    assert main(["freehand", *fields]) == 0
    away = ball_of(tmp_path / "out" / "volume.nrrd")[0] - ball_of(reconstructed / "volume.nrrd")[0]
    assert np.linalg.norm(away) == pytest.approx(3, abs=0.1)


def test_the_tissues_speed_of_sound_scales_depths_alike_in_volume_and_sequence(capture, reconstructed, rig, tmp_path):
    """A calibration for 1488 m/s and tissue of 1450: 2.6 % less deep. A sequence's own calibration counts as one for 1540."""
    probe = sweep_part.read_sweep(capture).probe
    probe_files.write(tmp_path / "probe.yaml", replace(probe, speed_m_s=1488.0))
    fields = [f"capture={capture}", f"lag_s={LAG_S}", f"probe={tmp_path / 'probe.yaml'}", "tissue_m_s=1450"]
    assert main(["freehand", *fields, f"out={tmp_path / 'out'}"]) == 0
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["speed_m_per_s"] == 1450
    frames = sequences.read_tracking(tmp_path / "out" / "sequence.igs.mha")
    ours = sequences.poses(frames, "Reference", "Image")
    shown = sequences.poses(sequences.read_tracking(reconstructed / "sequence.igs.mha"), "Reference", "Image")
    np.testing.assert_allclose(ours[:, :3, 1], shown[:, :3, 1] * 1450 / 1488, atol=1e-9)
    np.testing.assert_allclose(ours[:, :3, 3], shown[:, :3, 3], atol=1e-9)
    depth = np.linalg.inv(shown[20]) @ [*sweep_sets.BALL, 1]  # px, of the ball in the middle of the sweep
    expected = (ours[20] @ [depth[0], depth[1], 0, 1])[:3] - (shown[20] @ [depth[0], depth[1], 0, 1])[:3]
    moved = ball_of(tmp_path / "out" / "volume.nrrd")[0] - ball_of(reconstructed / "volume.nrrd")[0]
    assert np.linalg.norm(moved - expected) < 0.2 and np.linalg.norm(expected) > 0.5
    again = [f"sequence={reconstructed / 'sequence.igs.mha'}", f"tissue_m_s={1540 * 1450 / 1488}"]
    assert main(["freehand", *again, f"out={tmp_path / 'again'}"]) == 0
    moved = ball_of(tmp_path / "again" / "volume.nrrd")[0] - ball_of(reconstructed / "volume.nrrd")[0]
    assert np.linalg.norm(moved - expected) < 0.2


def test_what_is_wrong_is_said_in_one_line_and_nothing_is_written(capture, reconstructed, rig, tmp_path, capsys):
    out = tmp_path / "out"

    def complaint(*fields: str) -> str:
        assert main(["freehand", f"out={out}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    bare, sequence = sweep_sets.ball(tmp_path / "bare", rig, with_probe=False), reconstructed / "sequence.igs.mha"
    assert complaint() == "freehand: expected capture or sequence, found neither"
    assert complaint(f"capture={bare}") == f"{bare}: expected the probe's calibration, found none; give probe=..."
    assert complaint(f"capture={capture}", "config=a.xml").startswith("freehand: config: expected a configuration with a seq")
    assert complaint(f"sequence={sequence}", "lag_sigma_s=0.1").startswith("freehand: lag_sigma_s: expected none with a seq")
    assert complaint(f"sequence={sequence}", "reference=Stylus").startswith(
        f"{sequence}: transforms: expected some that lead from Image to Stylus, found ImageToProbe"
    )
    assert complaint(f"sequence={sequence}", "reference=tracker").startswith("freehand: reference: expected ")
    assert complaint(f"sequence={sequence}", "target=Stylus").startswith("freehand: target: expected a probe with it")
    assert complaint(f"capture={capture}", "image=Image").startswith("freehand: image: expected none without a sequence")
    for field in ("spacing_mm=0.001", "most_gib=2000", "lag_s=-1e7", "tissue_m_s=10"):
        assert complaint(f"capture={capture}", field).startswith(f"freehand: {field.partition('=')[0]}: expected ")
    assert complaint(f"capture={capture}", "spacing_mm=0.01").startswith("volume: expected at most 4.0 GiB, found ")
    assert complaint(f"capture={capture}", "clip=[90,0,10,10]").startswith("clip: expected a part of an image of 80x100")
    assert complaint(f"capture={capture}", "clip=[0,0,0,10]").startswith("freehand: clip.2: expected ")
    assert complaint(f"capture={capture}", f"probe={tmp_path}").startswith(f"{tmp_path}: expected a probe's calibration")
    assert complaint(f"sequence={tmp_path / 'a.igs.mha'}").startswith(f"{tmp_path / 'a.igs.mha'}: expected ")
    assert not out.exists()
