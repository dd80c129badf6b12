"""A probe's calibration survives its files, and a bad file is refused in one line."""

import cv2
import numpy as np
import pytest

from recon.capture import probe_files
from recon.capture.probe_dialects import own_probe
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration


@pytest.fixture
def probe(rig, rng):
    root = rng.standard_normal((8, 8)) * 1e-3
    uncertainty = Uncertainty(probe_files.PARAMETERS, root @ root.T)
    return ProbeCalibration(rig.probe.target_from_image.matrix(), np.array(rig.probe.scale_mm_per_px), uncertainty, 1488.3)


def test_what_is_written_is_read(probe, tmp_path):
    path = tmp_path / "probe.yaml"
    probe_files.write(path, probe)
    back = probe_files.read(path)
    assert np.array_equal(back.target_from_image, probe.target_from_image)
    assert np.array_equal(back.scale, probe.scale) and back.speed_m_s == 1488.3
    assert back.uncertainty.names == probe.uncertainty.names
    assert back.uncertainty.covariance == pytest.approx(probe.uncertainty.covariance)


def test_opencv_reads_it_plainly(probe, tmp_path):
    path = tmp_path / "probe.yaml"
    probe_files.write(path, ProbeCalibration(probe.target_from_image, probe.scale))
    storage = cv2.FileStorage(str(path), cv2.FileStorage_READ)
    assert np.array_equal(storage.getNode("target_from_image").mat(), probe.target_from_image)
    assert probe_files.read(path).uncertainty is None


def test_the_authors_file(probe, tmp_path):
    path = tmp_path / probe_files.AUTHORS
    probe_files.write_authors(path, probe)
    stored = np.load(path)
    assert sorted(stored.files) == ["T_I_T", "speed_m_s", "sx", "sy"]
    back = probe_files.read(path)
    assert back.speed_m_s == probe.speed_m_s == 1488.3, "as it was calibrated in water"
    assert np.array_equal(back.target_from_image, probe.target_from_image) and np.array_equal(back.scale, probe.scale)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("sonotwin-probe/1", "sonotwin-probe/9", "schema: expected sonotwin-probe/1, found sonotwin-probe/9"),
        ("target_from_image:", "image:", "target_from_image: expected a matrix, found none"),
        ("scale:", "size:", "scale: expected a matrix, found none"),
        ("speed_m_s: 1488.3", "speed_m_s: 1.4883", "speed_m_s: expected a speed of sound of 300 to 5000 m/s, found 1.4883: km/s"),
        ("speed_m_s: 1488.3", "speed_m_s: .Nan", "speed_m_s: expected a speed of sound of 300 to 5000 m/s, found nan"),
        ("speed_m_s: 1488.3", "speed_m_s: fast", "speed_m_s: expected a number, of m/s, found 'fast'"),
        ("   - sx\n", "   - sz\n", "parameters: expected some of"),
        ("   - sx\n", "   - sy\n", "parameters: expected some of"),
        ("   - sx\n", "", "covariance: expected 7x7"),
        ("%YAML", "\x00", "damaged"),
    ],
)
def test_a_bad_file_is_refused(probe, tmp_path, old, new, named):
    path = tmp_path / "probe.yaml"
    probe_files.write(path, probe)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=named) as raised:
        probe_files.read(path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"T_I_T": np.diag([1.0, 1, -1, 1])}, "T_I_T: .*right-handed frame, in mm, found a left-handed frame"),
        ({"T_I_T": np.eye(3)}, "T_I_T"),
        ({"T_I_T": np.full((4, 4), np.nan)}, "T_I_T"),
        ({"sx": 0.0}, "scale"),
        ({"sy": [0.1, 0.2]}, "sy: expected one number"),
        ({"speed_m_s": 1.488}, "speed_m_s: expected a speed of sound of 300 to 5000 m/s, found 1.488"),
        ({"speed_m_s": [1488.0, 1540.0]}, "speed_m_s: expected one number"),
        ({"speed_m_s": "water"}, "speed_m_s: expected numbers"),
    ],
)
def test_values_that_are_no_probe_are_refused(tmp_path, change, named):
    path = tmp_path / probe_files.AUTHORS
    np.savez(path, **{"sx": 0.1, "sy": 0.1, "T_I_T": np.eye(4), **change})
    with pytest.raises(InputError, match=named):
        probe_files.read(path)


def test_no_file_and_no_matrix_are_refused(tmp_path):
    with pytest.raises(InputError, match="found none"):
        probe_files.read(tmp_path / "none.yaml")
    (tmp_path / "list.yaml").write_text("%YAML:1.0\n---\n- 1\n")
    with pytest.raises(InputError, match=r"list\.yaml"):
        probe_files.read(tmp_path / "list.yaml")


def test_a_file_of_before_without_a_speed_is_for_the_scanners(probe, tmp_path):
    path = tmp_path / "probe.yaml"
    probe_files.write(path, probe)
    path.write_text("".join(line for line in path.read_text().splitlines(True) if "speed_m_s" not in line))
    assert probe_files.read(path).speed_m_s == 1540.0


def test_a_file_of_the_authors_is_told_its_speed_or_warned_of(tmp_path, caplog):
    """It names none: in water of 22 degrees 1540 m/s would be 3.4 % off, so that isn't taken without a word."""
    path = tmp_path / probe_files.AUTHORS
    np.savez(path, sx=0.12, sy=0.12, T_I_T=np.eye(4))
    assert probe_files.read(path, 1488.0).speed_m_s == 1488.0 and not caplog.messages
    assert probe_files.read(path).speed_m_s == 1540.0
    (said,) = caplog.messages
    assert "names no speed of sound" in said and "import it with speed_m_s=..." in said


def test_a_plain_matrix_is_told_a_way_that_it_has(tmp_path, caplog):
    """It has no place for a speed or a unit: both go into the authors' file, which then reads alike."""
    path, authors = tmp_path / "matrix.txt", tmp_path / probe_files.AUTHORS
    placed = rigid.transform(np.eye(3), [0.1, 0.2, 0.3])
    np.savetxt(path, placed @ np.diag([0.12, 0.12, 0.12, 1]))
    with pytest.raises(InputError, match=rf"if it is right, give it as {authors.name} with sx, sy, T_I_T and mm_per_unit=1$"):
        probe_files.read(path)
    np.savez(authors, sx=0.12, sy=0.12, T_I_T=placed, mm_per_unit=1)
    assert probe_files.read(authors, 1488.0).target_from_image == pytest.approx(placed)
    caplog.clear()
    np.savetxt(path, rigid.transform(np.eye(3), [0, 90, 0]) @ np.diag([0.12, 0.12, 0.12, 1]))
    assert probe_files.read(path, 1488.0).speed_m_s == 1488.0 and not caplog.messages
    assert probe_files.read(path).speed_m_s == 1540.0
    assert [f"made in water, give it as {authors.name}" in text for text in caplog.messages] == [True]


def test_a_note_of_our_schema_makes_no_file_ours(probe, tmp_path):
    """A configuration of PLUS may say where its matrix is from. Ours are those of OpenCV, in each of its ways to write."""
    placed = probe.target_from_image @ np.diag([*probe.scale, 1, 1])
    plus = tmp_path / "config.xml"
    words = " ".join(map(repr, placed.ravel().tolist()))
    transform = f'<Transform From="Image" To="Probe" Matrix="{words}"/>'
    note = f"<!-- of {own_probe.SCHEMA} -->"
    plus.write_text(f"<PlusConfiguration>{note}{transform}</PlusConfiguration>", encoding="utf-8")
    assert not own_probe.recognises(plus)
    assert probe_files.read(plus, 1488.3).target_from_image == pytest.approx(probe.target_from_image)
    for suffix in ("yaml", "xml", "json"):
        own = tmp_path / f"own.{suffix}"
        storage = cv2.FileStorage(str(own), cv2.FileStorage_WRITE)
        storage.write("schema", own_probe.SCHEMA)
        storage.write("target_from_image", probe.target_from_image)
        storage.write("scale", probe.scale.reshape(1, 2))
        storage.release()
        assert own_probe.recognises(own) and probe_files.read(own).scale == pytest.approx(probe.scale)
