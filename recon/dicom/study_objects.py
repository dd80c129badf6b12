"""What all objects of a study share: patient, study, series, equipment, references, and identifiers made of the content.

Source: DICOM PS3.3 2024, C.7 (patient, study, series, equipment), C.12.1 (SOP common). Identifiers are UUIDs of a digest
(PS3.5, B.2), so that the same results have the same ones whenever they are written.
"""

import hashlib
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sr.coding import Code
from pydicom.uid import UID, ExplicitVRLittleEndian
from pydicom.valuerep import format_number_as_ds

from recon.dicom.patient_fields import Coded, Patient
from recon.files import atomic
from recon.files.volumes import Volume
from recon.geometry import rigid
from recon.segmentation.mass_files import FoundMass

Array = NDArray[np.float64]

OURS = "99SONOTWIN"  # scheme of codes that the standard lacks
MAKER = "sonotwin"
NO_DATE, NO_TIME = "19000101", "000000"  # where a date must be and none is given
NAMESPACE = uuid.UUID("6f5f4a86-5a0e-4d1b-9d4e-6a2b7f0c53d1")  # of the study's identifiers
MASS_FAMILY = Code("123103", "DCM", "Edge Detection")  # of CID 7162
CATEGORY_OF_MASS = Code("49755003", "SCT", "Morphologically Abnormal Structure")


@dataclass(frozen=True, eq=False)
class Results:
    """What goes into a study, in one frame, mm."""

    volume: Volume  # voxels of 8 or 16 bits without sign
    masses: Mapping[str, FoundMass]
    skin: trimesh.Trimesh | None = None
    remarks: Sequence[str] = ()  # on the search for masses

    def moved(self, to_from: Array) -> "Results":
        """The same in another frame, which differs by a turn; figures stay as they are."""
        masses = {name: FoundMass(moved_mesh(mass.mesh, to_from), mass.figures) for name, mass in self.masses.items()}
        return Results(
            moved_volume(self.volume, to_from),
            masses,
            None if self.skin is None else moved_mesh(self.skin, to_from),
            self.remarks,
        )

    def digest(self) -> str:
        """A digest of all of it."""
        found = hashlib.sha256(repr(tuple(self.remarks)).encode())
        skin = {} if self.skin is None else {"skin": self.skin}
        for values in (self.volume.voxels, self.volume.origin, self.volume.spacing, self.volume.directions):
            _add(found, values)
        for name, mesh in (*((name, mass.mesh) for name, mass in self.masses.items()), *skin.items()):
            found.update(name.encode())
            for values in (mesh.vertices, mesh.faces):
                _add(found, values)
        found.update(repr([(name, sorted(mass.figures.items())) for name, mass in self.masses.items()]).encode())
        return found.hexdigest()


@dataclass(frozen=True)
class Study:
    """Whom a study is of, and what its identifiers are made of."""

    patient: Patient
    digest: str

    @classmethod
    def of(cls, patient: Patient, results: Results) -> "Study":
        """The study of some results."""
        content = f"{maker_version()} {patient.model_dump_json()} {results.digest()}"
        return cls(patient, hashlib.sha256(content.encode()).hexdigest())

    def uid(self, of: str) -> UID:
        """The identifier of a part of the study, by its name."""
        if of == "study" and self.patient.study_uid:
            return UID(self.patient.study_uid)
        return UID(f"2.25.{uuid.uuid5(NAMESPACE, f'{self.digest} {of}').int}")

    def begun(self, part: str, sop_class: UID, modality: str, number: int, description: str) -> Dataset:
        """An object with the modules of patient, study, series, equipment and frame of reference."""
        one, patient = Dataset(), self.patient
        one.SpecificCharacterSet = "ISO_IR 192"
        one.SOPClassUID, one.SOPInstanceUID = sop_class, self.uid(part)
        one.PatientName = patient.name or "Anonymous^Patient"
        one.PatientID = patient.id or f"ANON-{self.digest[:12].upper()}"
        one.PatientBirthDate, one.PatientSex = patient.birth_date, patient.sex
        one.PatientIdentityRemoved = "NO" if patient.identified else "YES"
        if not patient.identified:
            one.DeidentificationMethod = "sonotwin export: written without data of the patient"
        one.LongitudinalTemporalInformationModified = "UNMODIFIED" if patient.date else "REMOVED"
        one.StudyInstanceUID, one.StudyID = self.uid("study"), patient.study_id
        one.StudyDate, one.StudyTime = patient.date, patient.time
        one.AccessionNumber, one.ReferringPhysicianName = patient.accession_number, patient.referring_physician
        one.StudyDescription = patient.study_description or "Freehand ultrasound with light scan"
        one.Modality, one.SeriesNumber, one.InstanceNumber = modality, number, 1
        one.SeriesInstanceUID, one.SeriesDescription = self.uid(f"series {part}"), description
        one.FrameOfReferenceUID, one.PositionReferenceIndicator = self.uid("frame of reference"), ""
        one.Manufacturer = one.ManufacturerModelName = MAKER
        one.DeviceSerialNumber, one.SoftwareVersions = "software", maker_version()
        one.ContentDate, one.ContentTime = patient.date or NO_DATE, patient.time or NO_TIME
        return one


def maker_version() -> str:
    """The version of this software."""
    try:
        return version("sonotwin")
    except PackageNotFoundError:
        return "unknown"


def write(path: Path, one: Dataset) -> None:
    """Write an object, whole or not at all: uncompressed, little endian."""
    one.file_meta = FileMetaDataset()
    one.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    with atomic.new_file(path) as temporary:
        one.save_as(temporary, enforce_file_format=True)


def item(**values: object) -> Dataset:
    """An item of a sequence."""
    made = Dataset()
    for name, value in values.items():
        setattr(made, name, value)
    return made


def coded(code: Code | Coded) -> Dataset:
    """A code as an item (PS3.3, 8.8)."""
    value, scheme = (code.code, code.scheme) if isinstance(code, Coded) else (code.value, code.scheme_designator)
    return item(CodeValue=value, CodingSchemeDesignator=scheme, CodeMeaning=code.meaning)


def own_scheme() -> list[Dataset]:
    """What codes of our own are (PS3.3, C.12.1.1.7)."""
    return [item(CodingSchemeDesignator=OURS, CodingSchemeName="Codes of sonotwin", CodingSchemeResponsibleOrganization=MAKER)]


def algorithm(verb: str, family: Code) -> Dataset:
    """What made a segment (PS3.3, 10.16)."""
    return item(AlgorithmFamilyCodeSequence=[coded(family)], AlgorithmName=f"sonotwin {verb}", AlgorithmVersion=maker_version())


def decimals(values: Iterable[float]) -> list[str]:
    """Numbers as decimal strings, of the sixteen letters that these may have."""
    return [format_number_as_ds(float(value)) for value in values]


def reference(one: Dataset) -> Dataset:
    """A reference to an object."""
    return item(ReferencedSOPClassUID=one.SOPClassUID, ReferencedSOPInstanceUID=one.SOPInstanceUID)


def series_of(one: Dataset) -> Dataset:
    """An object by its series, as for what refers to it (PS3.3, C.12.2)."""
    return item(SeriesInstanceUID=one.SeriesInstanceUID, ReferencedInstanceSequence=[reference(one)])


def described_mass(study: Study, number: int, name: str) -> Dataset:
    """A mass as a segment (PS3.3, C.8.20.4)."""
    patient = study.patient
    return item(
        SegmentNumber=number,
        SegmentLabel=name,
        SegmentDescription=f"{patient.finding.meaning} {number}, found in tracked B-scans",
        SegmentAlgorithmType="AUTOMATIC",
        SegmentAlgorithmName="sonotwin segment",
        SegmentationAlgorithmIdentificationSequence=[algorithm("segment", MASS_FAMILY)],
        SegmentedPropertyCategoryCodeSequence=[coded(CATEGORY_OF_MASS)],
        SegmentedPropertyTypeCodeSequence=[coded(patient.finding)],
        AnatomicRegionSequence=[coded(patient.region)],
        TrackingID=name,
        TrackingUID=study.uid(f"tracked {name}"),
    )


def moved_volume(volume: Volume, to_from: Array) -> Volume:
    """A volume in another frame."""
    return Volume(volume.voxels, rigid.apply(to_from, volume.origin), volume.spacing, to_from[:3, :3] @ volume.directions)


def moved_mesh(mesh: trimesh.Trimesh, to_from: Array) -> trimesh.Trimesh:
    """A mesh in another frame, with its normals and what its vertices have."""
    normals = rigid.rotate(to_from, np.asarray(mesh.vertex_normals))
    moved = trimesh.Trimesh(
        rigid.apply(to_from, np.asarray(mesh.vertices)), mesh.faces, vertex_normals=normals, process=False, validate=False
    )
    moved.vertex_attributes.update(mesh.vertex_attributes)
    moved.metadata.update(mesh.metadata)
    return moved


def _add(found: "hashlib._Hash", values: NDArray) -> None:
    values = np.ascontiguousarray(values)
    found.update(f"{values.dtype.str} {values.shape}".encode())
    found.update(values.tobytes())
