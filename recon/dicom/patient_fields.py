"""What a study says of patient, order and day: a file that the hospital fills in, or nothing of it."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from recon.errors import InputError, validated
from recon.files import yaml_text
from recon.model.part import Part

Array = NDArray[np.float64]
Text = Annotated[str, Field(max_length=64, pattern=r"^[^\\\x00-\x1f\x7f]*$")]  # LO and PN of PS3.5, 6.2
Short = Annotated[str, Field(max_length=16, pattern=r"^[^\\\x00-\x1f\x7f]*$")]  # SH
Day = Annotated[str, Field(pattern=r"^((19|20)\d\d(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01]))?$")]
Clock = Annotated[str, Field(pattern=r"^(([01]\d|2[0-3])[0-5]\d[0-5]\d)?$")]
Direction = Literal["left", "right", "back", "front", "head", "feet"]

TOWARDS: dict[Direction, tuple[int, int, int]] = {  # in the patient's frame, PS3.3 C.7.6.2.1.1
    "left": (1, 0, 0),
    "right": (-1, 0, 0),
    "back": (0, 1, 0),
    "front": (0, -1, 0),
    "head": (0, 0, 1),
    "feet": (0, 0, -1),
}


class Coded(Part):
    """A term of a coding scheme."""

    code: Annotated[Short, Field(min_length=1)]
    scheme: Annotated[Short, Field(min_length=1)] = "SCT"
    """SCT is SNOMED CT"""
    meaning: Annotated[Text, Field(min_length=1)]


class Patient(Part):
    """Patient, order and day. As it stands without any field it names nobody."""

    name: Text = ""
    """Family^Given; "" is Anonymous^Patient"""
    id: Text = ""
    """of the patient, as the hospital has it; "" is made of the content's digest"""
    birth_date: Day = ""
    """YYYYMMDD, in quotes"""
    sex: Literal["", "F", "M", "O"] = ""
    study_uid: Annotated[str, Field(max_length=64, pattern=r"^((0|[1-9]\d*)(\.(0|[1-9]\d*))+)?$")] = ""
    """of the study that the results belong to; "" makes one"""
    study_id: Short = ""
    accession_number: Short = ""
    """of the order"""
    study_description: Text = ""
    referring_physician: Text = ""
    date: Day = ""
    """YYYYMMDD, in quotes, of the recording; "" leaves days empty, and 19000101 where DICOM needs one"""
    time: Clock = ""
    """HHMMSS, in quotes"""
    laterality: Literal["", "L", "R"] = ""
    """of what was scanned"""
    region: Coded = Coded(code="76752008", meaning="Breast")
    """what was scanned; {code: "706342009", meaning: Phantom} is a phantom"""
    finding: Coded = Coded(code="4147007", meaning="Mass")
    """what the segmented bodies are called"""
    axes: tuple[Direction, Direction, Direction] = ("left", "back", "head")
    """where the world's x, y, z (right, down and away, as camera 1 sees them) point in the patient"""

    @model_validator(mode="after")
    def _a_frame(self) -> "Patient":
        if round(np.linalg.det(self.patient_from_world[:3, :3])) != 1:
            raise ValueError(f"axes: expected three directions at right angles, right-handed, found {list(self.axes)}")
        if self.time and not self.date:
            raise ValueError(f"time: expected with a date, found {self.time} without")
        return self

    @property
    def identified(self) -> bool:
        """Whether a person may be told from it."""
        named = self.name, self.id, self.birth_date, self.study_uid, self.study_id, self.accession_number
        return any((*named, self.study_description, self.referring_physician))

    @property
    def patient_from_world(self) -> Array:
        """The turn (4, 4) from the frame of camera 1 to that of the patient: x to the left, y to the back, z to the head."""
        matrix = np.eye(4)
        matrix[:3, :3] = np.array([TOWARDS[axis] for axis in self.axes], float).T
        return matrix


def read(path: Path) -> Patient:
    """Read a YAML file; InputError if it is missing, empty or damaged, or has fields that aren't known or DICOM can't hold."""
    content = yaml_text.read(path, "a file of a patient's fields")
    if content is None:
        raise InputError(f"{path}: expected a patient's fields, found none; leave patient out for a study that names nobody")
    return validated(Patient, content, path)
