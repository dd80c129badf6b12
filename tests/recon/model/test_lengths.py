"""Lengths in another unit are refused where they enter, with the likely unit; usual and stated ones pass."""

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from recon.capture import calibration_files, probe_files
from recon.errors import InputError, one_line
from recon.freehand import scans, sequences
from recon.freehand.sequences import Frames
from recon.geometry import rigid
from recon.model.boards import Board
from recon.model.probe import ProbeCalibration, Speed
from recon.model.rig import Target
from recon.probe_calibration import sound_in_water
from sonotwin.cli import main

STEPS = {"asymmetric_circles": "spacing_mm", "symmetric_circles": "spacing_mm", "chessboard": "square_mm", "charuco": "square_mm"}
TURN = rigid.from_rotation_vector([0.2, 0.1, 1.2], [30, -50, 90])


def board(kind, factor=1.0, **more):
    circles = {"diameter_mm": 9.0 * factor} if "circles" in kind else {"marker_mm": 11.0 * factor} if kind == "charuco" else {}
    return TypeAdapter(Board).validate_python({"kind": kind, "columns": 7, "rows": 5, STEPS[kind]: 15 * factor} | circles | more)


@pytest.mark.parametrize("kind", STEPS)
def test_a_board_in_metres_is_refused_unless_it_is_meant(kind):
    for factor, unit in ((1e-3, "0.015 mm: metres?"), (1e3, "1.5e+04 mm: micrometres?")):
        with pytest.raises(ValidationError) as fault:
            board(kind, factor)
        said = one_line(fault.value)
        assert f"{STEPS[kind]}: expected 0.5 to 1000 mm, found {unit}" in said and "unusual=true" in said
        assert board(kind, factor, unusual=True).points().shape[1] == 3
    assert board(kind, 0.1) and board(kind, 20)  # 1.5 and 300 mm


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "metres"), (0.1, "centimetres"), (1e3, "micrometres")])
def test_a_target_in_another_unit_is_refused_unless_it_is_meant(factor, unit, rig):
    """Of the design's 25 and 40 mm between circles of 18 mm; half and five times as large are targets as well."""
    design = rig.target.model_dump()
    sizes = {name: design[name] for name in ("c1_mm", "c2_mm", "outer_diameter_mm", "inner_diameter_mm")}
    with pytest.raises(ValidationError) as fault:
        Target.model_validate(design | {name: factor * size for name, size in sizes.items()})
    assert f"c1_mm: expected 5 to 1000 mm, found {25 * factor:.4g} mm: {unit}? If it is right, give unusual=true" in str(
        fault.value
    )
    assert Target.model_validate(design | {name: factor * size for name, size in sizes.items()} | {"unusual": True})
    for usual in (0.5, 5):
        Target.model_validate(design | {name: usual * size for name, size in sizes.items()})


@pytest.mark.parametrize(
    ("value", "unit"), [(1.54, ": km/s?"), (154_000, ": cm/s?"), (1.54e6, ": mm/s?"), (50, ""), (np.nan, "")]
)
def test_a_speed_of_sound_in_another_unit_is_named(value, unit, tmp_path):
    complaint = f"expected a speed of sound of 300 to 5000 m/s, found {value:g}{unit}"
    with pytest.raises(ValidationError) as fault:
        TypeAdapter(Speed).validate_python(value)
    assert one_line(fault.value) == complaint
    with pytest.raises(InputError) as said:
        sound_in_water.for_tissue(ProbeCalibration(TURN, np.array([0.1, 0.1])), value)
    assert str(said.value) == f"speed: {complaint}"


def pair(path, unit_mm, **more):
    matrix = np.array([[1000.0, 0, 300], [0, 1000, 200], [0, 0, 1]])
    motion = {"R": np.eye(3), "t": np.array([160.0, 0, 20]) / unit_mm}
    np.savez(path, K1=matrix, dist1=np.zeros(5), K2=matrix, dist2=np.zeros(5), **motion, **more)
    return path


def test_a_calibration_in_metres_is_refused_or_read_as_such(tmp_path):
    sizes = {"cam1": (640, 480), "cam2": (640, 480)}
    with pytest.raises(InputError, match=r"cam2: expected 2 to 20000 mm from cam1, found 0.1612 mm: metres\? give mm_per_unit"):
        calibration_files.read(pair(tmp_path / "pair.npz", 1000), sizes)
    for unit, apart in ((1000, 161.245), (1, 0.161245)):
        found = calibration_files.read(pair(tmp_path / "pair.npz", 1000, mm_per_unit=unit), sizes)
        assert np.linalg.norm(found.cameras["cam2"].camera_from_world[:3, 3]) == pytest.approx(apart, rel=1e-5)
    with pytest.raises(InputError, match=r"mm_per_unit: expected a number of 0.001 to 1000"):
        calibration_files.read(pair(tmp_path / "pair.npz", 1000, mm_per_unit=0.0), sizes)


def test_a_calibration_that_may_be_in_centimetres_is_doubted_unless_stated(tmp_path, caplog):
    sizes = {"cam1": (640, 480), "cam2": (640, 480)}
    calibration_files.read(pair(tmp_path / "pair.npz", 1), sizes)
    calibration_files.read(pair(tmp_path / "pair.npz", 10, mm_per_unit=10.0), sizes)
    calibration_files.read(pair(tmp_path / "pair.npz", 10, mm_per_unit=1.0), sizes)
    assert not caplog.text
    calibration_files.read(pair(tmp_path / "pair.npz", 10), sizes)
    assert "cam2: its distance from cam1 is 16.12 mm: is it in mm, not in centimetres or inches? give mm_per_unit" in caplog.text


@pytest.mark.parametrize(("scale", "shift", "complaint"), [
    ([0.12e-3, 0.12e-3], [30, -50, 90], "sx: expected 0.002 to 5 mm a pixel, found 0.00012 mm: metres?"),
    ([0.12, 0.12], [0.03, -0.05, 0.09], "target_from_image: expected 1 to 2000 mm from the target to the"),
])  # fmt: skip
def test_a_probe_in_metres_is_refused_unless_it_is_stated(scale, shift, complaint, tmp_path):
    path = tmp_path / "probe.yaml"
    probe_files.write(path, ProbeCalibration(rigid.transform(TURN[:3, :3], shift), np.array(scale)))
    written = path.read_text()
    assert probe_files.read(path).scale.tolist() == scale, "what is written says that it is in mm"
    path.write_text("".join(line for line in written.splitlines(keepends=True) if "mm_per_unit" not in line))
    with pytest.raises(InputError) as fault:
        probe_files.read(path)
    assert complaint in str(fault.value) and "metres?" in str(fault.value)
    path.write_text(path.read_text() + "mm_per_unit: 1000\n")
    assert probe_files.read(path).scale == pytest.approx(1000 * np.array(scale))


def test_a_bracket_that_may_be_in_centimetres_is_doubted_unless_stated(tmp_path, caplog):
    path = tmp_path / "probe.yaml"
    probe_files.write(path, ProbeCalibration(rigid.transform(TURN[:3, :3], [30, -50, 90]), np.full(2, 0.12)))
    probe_files.read(path)
    probe_files.write(path, ProbeCalibration(rigid.transform(TURN[:3, :3], [3, -5, 9]), np.full(2, 0.12)))
    probe_files.read(path)
    assert not caplog.text, "what is written says that it is in mm"
    path.write_text("".join(line for line in path.read_text().splitlines(keepends=True) if "mm_per_unit" not in line))
    probe_files.read(path)
    assert "corner lies from the target by 10.72 mm: is it in mm, not in centimetres or inches? give mm_per_unit" in caplog.text


PLUS = """<PlusConfiguration><CoordinateDefinitions>
<Transform From="Image" To="Probe" Matrix="{}"/>
</CoordinateDefinitions></PlusConfiguration>"""
SHEARED = np.array([[0.1, -0.055, 0, 0], [0, 0.1, 0, 0], [0, 0, 0.1, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("form", ["{}", PLUS], ids=["text", "plus"])
def test_a_matrix_from_pixels_to_mm_is_a_probes_calibration(form, tmp_path, caplog):
    probe = ProbeCalibration(TURN, np.array([0.11, 0.125]))
    path = tmp_path / "ImageToProbe"
    matrix = sequences.target_from_pixel(probe)

    def read(matrix):
        path.write_text(form.format("\n".join(" ".join(f"{value:.9g}" for value in row) for row in matrix)))
        return probe_files.read(path, 1540.0)

    found = read(matrix)
    np.testing.assert_allclose(found.target_from_image, TURN, atol=1e-6)
    np.testing.assert_allclose(found.scale, [0.11, 0.125], atol=1e-8)
    assert not caplog.text
    skewed = matrix.copy()
    skewed[:3, 1] += 0.05 * skewed[:3, 0]
    assert read(skewed).scale.shape == (2,) and "degrees off a right angle, and are taken as square" in caplog.text
    skewed[:3, 1] -= 0.6 * skewed[:3, 0]
    for wrong, complaint in (
        (skewed, "expected an image with square axes, found axes at 116 degrees"),
        (TURN, "found a rigid transform: multiply them by sx and sy in mm/px"),
        (np.diag([0, 0.1, 0.1, 1]), "expected 4x4 finite numbers with a last row of 0 0 0 1, from pixels to mm, found others"),
    ):
        with pytest.raises(InputError, match=complaint):
            read(wrong)


def test_b_scans_that_may_be_in_centimetres_are_doubted(tmp_path, caplog):
    """Of 66 x 49 mm none is; of 6.6 x 4.9 mm some probes' are."""
    for pixel_mm, told in ((0.08, False), (0.008, True)):
        matrices = np.tile(np.diag([pixel_mm, pixel_mm, 1, 1]), (4, 1, 1))
        placed = scans.Scans((616, 820), matrices, lambda: iter(()), 1540.0, 1540.0)
        scans.check_size(placed, "s", None, "refuse")
        assert ("s: a side of the B-scans is 6.56 mm: is it in mm, not in centimetres or inches?" in caplog.text) == told


@pytest.mark.parametrize(("image_to_probe", "complaint"), [
    (np.eye(4), "B-scans: expected sides of 2 to 600 mm, found 820 mm, pixels of 1 mm: the identity in place of"),
    (np.diag([1e-4, 1e-4, 1e-4, 1]), "B-scans: expected sides of 2 to 600 mm, found 0.082 mm: metres?"),
    (SHEARED, "expected square axes, found axes at 119 degrees"),
])  # fmt: skip
@pytest.mark.parametrize("by", ["sequence", "config"])
def test_b_scans_of_no_scanner_are_refused(image_to_probe, complaint, by, tmp_path, capsys):
    count = 4
    yes = np.ones(count, bool)
    transforms = {"ProbeToTracker": np.array([rigid.transform(np.eye(3), [0, 5 * k, 600]) for k in range(count)])}
    if by == "sequence":
        transforms["ImageToProbe"] = np.tile(image_to_probe, (count, 1, 1))
    path, config = tmp_path / "s.igs.mha", tmp_path / "c.xml"
    images = np.zeros((count, 616, 820), np.uint8)
    sequences.write_sequence(path, Frames(np.arange(count) / 20, transforms, dict.fromkeys([*transforms, "Image"], yes), images))
    config.write_text(PLUS.format(" ".join(map(str, image_to_probe.ravel()))))
    fields = [f"sequence={path}", "reference=Tracker", f"out={tmp_path / 'out'}", "spacing_mm=2"]
    fields += [f"config={config}"] if by == "config" else []
    assert main(["freehand", *fields]) == 2
    said = capsys.readouterr().err
    assert complaint in said and "give implausible=take" in said and said.count("\n") == 1 and not (tmp_path / "out").exists()
    if by == "sequence" and image_to_probe[0, 1]:
        assert main(["freehand", *fields, "implausible=take"]) == 0
