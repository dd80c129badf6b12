"""A report of masses for archives: size, place and distance to the skin of each, with standard deviations.

A Comprehensive 3D SR by the template of measurement reports: TID 1500, a group by TID 1411 for each segment, its measurements by
TID 1419. Lengths of the axes are extents of the surface along its principal axes; a border that is off by the same length
everywhere makes their standard deviation 2 / A of the volume's, with A the surface's area.

Source: DICOM PS3.16, TID 300, 1204, 1002, 1500, 1411, 1419; PS3.3, A.35.13.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.sr.coding import Code
from pydicom.uid import Comprehensive3DSRStorage

from recon.dicom import received_file
from recon.dicom.patient_fields import Coded
from recon.dicom.received_file import fault, numbers
from recon.dicom.study_objects import MAKER, OURS, Study, coded, decimals, item, own_scheme, reference
from recon.files.metrics import Metrics
from recon.segmentation.mass_files import FoundMass

Array = NDArray[np.float64]

KIND = "a Comprehensive 3D SR of masses"
ROOT = Code("126000", "DCM", "Imaging Measurement Report")
GROUP = Code("125007", "DCM", "Measurement Group")
MEASUREMENTS = Code("126010", "DCM", "Imaging Measurements")
TRACKED = Code("112039", "DCM", "Tracking Identifier")
CENTRE = Code("128138", "DCM", "Center of Mass")
DEVIATION = Code("386136009", "SCT", "Standard Deviation")
OF_PREDICTION = Code("121405", "DCM", "Population Description")
COMMENT = Code("121106", "DCM", "Comment")
MM, MM3 = Code("mm", "UCUM", "millimeter"), Code("mm3", "UCUM", "cubic millimeter")

FIGURES = {  # by their names in metrics
    "volume_mm3": (Code("118565006", "SCT", "Volume"), MM3),
    "major_mm": (Code("131187009", "SCT", "Major Axis"), MM),
    "middle_mm": (Code("131189007", "SCT", "Perpendicular Axis"), MM),
    "minor_mm": (Code("131188004", "SCT", "Minor Axis"), MM),
    "depth_mm": (Code("121243", "DCM", "Distance from skin"), MM),
    "centre_sigma_mm": (Code("SN3", OURS, "Standard deviation of the center of mass, as a distance"), MM),
}
MEANT = "Standard deviation of the predicted error of this measurement, of calibration, tracking, sound and noise; no population"
MOST_DEPTH = 12  # of items within items


def measured(mass: FoundMass) -> Metrics:
    """Figures of a mass for the report, in its mesh's frame : those that aren't known are left out."""
    known = {name: float(value) for name, value in mass.figures.items() if math.isfinite(value)}
    volume = known.get("volume_mm3", abs(float(mass.mesh.volume)))
    sigma = known.get("volume_sigma_mm3", math.nan)
    found: Metrics = {"volume_mm3": volume, "volume_sigma_mm3": sigma}
    for name, extent in zip(("major", "middle", "minor"), axes(mass.mesh), strict=True):
        found |= {f"{name}_mm": extent, f"{name}_sigma_mm": 2 * sigma / float(mass.mesh.area)}
    found |= {name: known[name] for name in ("depth_mm", "depth_sigma_mm", "centre_sigma_mm") if name in known}
    found |= {f"centre_{axis}_mm": float(value) for axis, value in zip("xyz", mass.mesh.center_mass, strict=True)}
    return {name: value for name, value in found.items() if math.isfinite(value)}


def axes(mesh: trimesh.Trimesh) -> list[float]:
    """Extents of a closed mesh along its principal axes of inertia, the longest first, mm."""
    directions = np.linalg.eigh(mesh.moment_inertia)[1]
    return sorted(np.ptp(np.asarray(mesh.vertices) @ directions, axis=0).tolist(), reverse=True)


def built(
    study: Study, volume: Dataset, segments: Dataset | None, figures: Mapping[str, Metrics], remarks: Sequence[str] = ()
) -> Dataset:
    """The report on masses, by their names in the order of the segments, with remarks on the search for them."""
    one = study.begun("report", Comprehensive3DSRStorage, "SR", 4, "Measurements of masses")
    del one.FrameOfReferenceUID, one.PositionReferenceIndicator
    one.CodingSchemeIdentificationSequence = own_scheme()
    one.ReferencedPerformedProcedureStepSequence, one.PerformedProcedureCodeSequence = [], []
    one.CompletionFlag, one.VerificationFlag, one.PreliminaryFlag = "COMPLETE", "UNVERIFIED", "FINAL"
    sources = [volume, *([] if segments is None else [segments])]
    by_series = [
        item(SeriesInstanceUID=source.SeriesInstanceUID, ReferencedSOPSequence=[reference(source)]) for source in sources
    ]
    one.CurrentRequestedProcedureEvidenceSequence = [
        item(StudyInstanceUID=one.StudyInstanceUID, ReferencedSeriesSequence=by_series)
    ]
    one.ValueType, one.ContinuityOfContent = "CONTAINER", "SEPARATE"
    one.ConceptNameCodeSequence = [coded(ROOT)]
    one.ContentTemplateSequence = [item(MappingResource="DCMR", TemplateIdentifier="1500")]
    groups = [_group(study, segments, number, name, mass) for number, (name, mass) in enumerate(figures.items(), 1)]
    content = [*_context(study), _library(volume, study)]
    if groups:
        content.append(_container("CONTAINS", MEASUREMENTS, groups))
    if remarks:
        texts = [_text("CONTAINS", COMMENT, remark) for remark in remarks]
        content.append(_container("CONTAINS", Code("C0034375", "UMLS", "Qualitative Evaluations"), texts))
    one.ContentSequence = content
    return one


def _context(study: Study) -> list[Dataset]:
    """Language, observer and procedure (TID 1204, 1001, 1500)."""
    english = _code(
        "HAS CONCEPT MOD", Code("121049", "DCM", "Language of Content Item and Descendants"), Code("en", "RFC5646", "English")
    )
    device = Code("121007", "DCM", "Device")
    return [
        english,
        _code("HAS OBS CONTEXT", Code("121005", "DCM", "Observer Type"), device),
        _uid("HAS OBS CONTEXT", Code("121012", "DCM", "Device Observer UID"), study.uid("device")),
        _text("HAS OBS CONTEXT", Code("121013", "DCM", "Device Observer Name"), MAKER),
        _code(
            "HAS CONCEPT MOD", Code("121058", "DCM", "Procedure reported"), Code("16310003", "SCT", "Diagnostic ultrasonography")
        ),
    ]


def _library(volume: Dataset, study: Study) -> Dataset:
    """The image that was measured (TID 1600)."""
    image = _image("CONTAINS", None, volume)
    modality = _code("HAS ACQ CONTEXT", Code("121139", "DCM", "Modality"), Code("US", "DCM", "Ultrasound"))
    region = _code("HAS ACQ CONTEXT", Code("123014", "DCM", "Target Region"), study.patient.region)
    group = _container("CONTAINS", Code("126200", "DCM", "Image Library Group"), [modality, region, image])
    return _container("CONTAINS", Code("111028", "DCM", "Image Library"), [group])


def _group(study: Study, segments: Dataset | None, number: int, name: str, figures: Metrics) -> Dataset:
    """Measurements of a mass (TID 1411)."""
    assert segments is not None
    segment = _image("CONTAINS", Code("121191", "DCM", "Referenced Segment"), segments)
    segment.ReferencedSOPSequence[0].ReferencedSegmentNumber = number
    finding_site = Code("363698007", "SCT", "Finding Site")
    source = segments.ReferencedSeriesSequence[0].SeriesInstanceUID
    content = [
        _text("HAS OBS CONTEXT", TRACKED, name),
        _uid("HAS OBS CONTEXT", Code("112040", "DCM", "Tracking Unique Identifier"), study.uid(f"tracked {name}")),
        _code("CONTAINS", Code("121071", "DCM", "Finding"), study.patient.finding),
        segment,
        _uid("CONTAINS", Code("121232", "DCM", "Source series for segmentation"), source),
        _code("HAS CONCEPT MOD", finding_site, study.patient.region),
    ]
    for figure, (concept, unit) in FIGURES.items():
        if figure in figures:
            content.append(_number(concept, unit, figures[figure], figures.get(_sigma_of(figure))))
    centre = item(
        RelationshipType="CONTAINS",
        ValueType="SCOORD3D",
        ConceptNameCodeSequence=[coded(CENTRE)],
        GraphicType="POINT",
        GraphicData=[figures[f"centre_{axis}_mm"] for axis in "xyz"],
        ReferencedFrameOfReferenceUID=study.uid("frame of reference"),
    )
    return _container("CONTAINS", GROUP, [*content, centre])


def _sigma_of(figure: str) -> str:
    stem, unit = figure.rsplit("_", 1)
    return f"{stem}_sigma_{unit}"


def _number(concept: Code, unit: Code, value: float, sigma: float | None) -> Dataset:
    """A measurement (TID 300), with its standard deviation as a property of it (TID 311)."""
    made = _numeric("CONTAINS", concept, unit, value)
    if sigma is not None:
        within = [_numeric("HAS PROPERTIES", DEVIATION, unit, sigma), _text("HAS PROPERTIES", OF_PREDICTION, MEANT)]
        made.ContentSequence = within
    return made


def _numeric(relation: str, concept: Code, unit: Code, value: float) -> Dataset:
    (text,) = decimals([value])
    number = item(NumericValue=text, FloatingPointValue=value, MeasurementUnitsCodeSequence=[coded(unit)])
    return item(
        RelationshipType=relation, ValueType="NUM", ConceptNameCodeSequence=[coded(concept)], MeasuredValueSequence=[number]
    )


def _container(relation: str, concept: Code, content: Sequence[Dataset]) -> Dataset:
    return item(
        RelationshipType=relation,
        ValueType="CONTAINER",
        ConceptNameCodeSequence=[coded(concept)],
        ContinuityOfContent="SEPARATE",
        ContentSequence=list(content),
    )


def _text(relation: str, concept: Code, text: str) -> Dataset:
    return item(RelationshipType=relation, ValueType="TEXT", ConceptNameCodeSequence=[coded(concept)], TextValue=text)


def _uid(relation: str, concept: Code, uid: str) -> Dataset:
    return item(RelationshipType=relation, ValueType="UIDREF", ConceptNameCodeSequence=[coded(concept)], UID=uid)


def _code(relation: str, concept: Code, value: Code | Coded) -> Dataset:
    return item(
        RelationshipType=relation,
        ValueType="CODE",
        ConceptNameCodeSequence=[coded(concept)],
        ConceptCodeSequence=[coded(value)],
    )


def _image(relation: str, concept: Code | None, one: Dataset) -> Dataset:
    made = item(RelationshipType=relation, ValueType="IMAGE", ReferencedSOPSequence=[reference(one)])
    if concept is not None:
        made.ConceptNameCodeSequence = [coded(concept)]
    return made


def read(path: Path, frame_of_reference: str | None = None) -> dict[str, Metrics]:
    """Figures by the masses' names: those of `FIGURES`, their standard deviations, and the centre in the patient's frame.

    frame_of_reference : that centres must be in; None takes any

    Raises
    ------
    InputError
        If the file is missing, damaged, compressed, of another class or template, in another unit or frame, or has values that
        are no numbers.
    """
    one = received_file.read(path, Comprehensive3DSRStorage, KIND)
    with received_file.refusing(path, KIND):
        if _named(one) != ROOT.value:
            raise fault(path, "ConceptNameCodeSequence", f"{ROOT.value}, {ROOT.meaning}", _named(one))
        found = dict[str, Metrics]()
        for group in _groups(one, MOST_DEPTH):
            names = [str(each.TextValue) for each in group.ContentSequence if _named(each) == TRACKED.value]
            if len(names) != 1 or names[0] in found:
                raise fault(path, "ContentSequence", "a Tracking Identifier of its own for each group", names)
            found[names[0]] = _figures(path, group, frame_of_reference)
        return found


def _named(one: Dataset) -> str:
    names = one.get("ConceptNameCodeSequence") or [Dataset()]
    return str(names[0].get("CodeValue", ""))


def _groups(one: Dataset, deeper: int) -> Iterator[Dataset]:
    for each in one.get("ContentSequence") or []:
        if _named(each) == GROUP.value:
            yield each
        elif deeper:
            yield from _groups(each, deeper - 1)


def _figures(path: Path, group: Dataset, frame_of_reference: str | None) -> Metrics:
    known = {concept.value: (figure, unit) for figure, (concept, unit) in FIGURES.items()}
    found: Metrics = {}
    for each in group.ContentSequence:
        if str(each.ValueType) == "NUM" and _named(each) in known:
            figure, unit = known[_named(each)]
            found[figure] = _value(path, each, unit)
            for within in each.get("ContentSequence") or []:
                if _named(within) == DEVIATION.value:
                    found[_sigma_of(figure)] = _value(path, within, unit)
        elif str(each.ValueType) == "SCOORD3D" and _named(each) == CENTRE.value:
            if frame_of_reference is not None and str(each.ReferencedFrameOfReferenceUID) != frame_of_reference:
                raise fault(
                    path,
                    "ReferencedFrameOfReferenceUID",
                    f"the volume's {frame_of_reference}",
                    each.ReferencedFrameOfReferenceUID,
                )
            centre = numbers(path, "GraphicData", each.GraphicData, 3)
            found |= {f"centre_{axis}_mm": float(value) for axis, value in zip("xyz", centre, strict=True)}
    return found


def _value(path: Path, one: Dataset, unit: Code) -> float:
    number = one.MeasuredValueSequence[0]
    found = str(number.MeasurementUnitsCodeSequence[0].CodeValue)
    if found != unit.value:
        raise fault(path, "MeasurementUnitsCodeSequence", unit.value, found)
    value = float(number.get("FloatingPointValue", number.NumericValue))
    if not (0 <= value < 1e12):
        raise fault(path, "NumericValue", "a finite number, not negative", value)
    return value
