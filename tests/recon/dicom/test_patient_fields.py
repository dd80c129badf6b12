"""Fields of a patient's file: what DICOM holds, and directions of a right-handed frame."""

from pathlib import Path

import numpy as np
import pytest

from recon.dicom import patient_fields
from recon.errors import InputError


def read(tmp_path, text):
    (tmp_path / "patient.yaml").write_text(text, encoding="utf-8")
    return patient_fields.read(tmp_path / "patient.yaml")


def test_without_fields_nobody_is_named(tmp_path):
    assert not read(tmp_path, "{}").identified
    assert not read(tmp_path, 'date: "20261130"\nregion: {code: "706342009", meaning: Phantom}').identified
    for named in ("name: Doe^Jane", "id: X1", 'birth_date: "19600101"', "study_uid: 1.2.3", 'accession_number: "7"'):
        assert read(tmp_path, named).identified


def test_the_page_shows_all_fields(tmp_path):
    page = (Path(__file__).parents[3] / "docs/freehand.md").read_text(encoding="utf-8")
    text = page.split("# patient.yaml\n")[1].split("```")[0]
    assert read(tmp_path, text).model_fields_set == set(patient_fields.Patient.model_fields)


def test_axes_turn_the_world_into_the_patient(tmp_path):
    """A patient on her back, seen from above with the head up: what lies away from the camera lies towards her back."""
    turn = read(tmp_path, "axes: [left, feet, back]").patient_from_world
    assert np.array_equal(turn[:3, :3] @ [0, 0, 5], [0, 5, 0])
    assert np.array_equal(turn[:3, :3] @ [0, 5, 0], [0, 0, -5])
    assert np.linalg.det(turn) == pytest.approx(1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("axes: [right, feet, back]", "axes: expected three directions at right angles, right-handed"),
        ("axes: [left, right, back]", "axes: expected three directions at right angles"),
        ("axes: [left, down, back]", "axes.1: expected 'left', 'right'"),
        ("name: 'a\\b'", "name"),
        ("date: 2026-11-30", "date"),
        ('time: "1200"', "time"),
        ('time: "120000"', "time: expected with a date"),
        ("study_uid: 1.02.3", "study_uid"),
        (f"name: {'x' * 65}", "name"),
        ("nme: Doe", "nme: expected no such field"),
        ("\n\n", "expected a patient's fields, found none"),
        ("- 1", "expected a map of fields"),
    ],
)
def test_what_dicom_cant_hold_is_refused(text, said, tmp_path):
    with pytest.raises(InputError, match=said) as refusal:
        read(tmp_path, text)
    assert "patient.yaml" in str(refusal.value) and "\n" not in str(refusal.value)
