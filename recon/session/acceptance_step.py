"""An acceptance test: captures or meshes of artefacts in their places, and poses of a tool in divots, to a certificate."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.acceptance import artefact_points, certificate_page, certificate_sheet, filament_probing, optical_acceptance
from recon.acceptance.artefact_points import Region
from recon.acceptance.certificates import Artefacts
from recon.acceptance.conformity import Limits
from recon.acceptance.optical_acceptance import CHARACTERISTICS, Acceptance, Measured
from recon.capture import surface_part, sweep_tables, tip_files
from recon.capture.images import image_files, read_grey
from recon.capture.manifest import MANIFEST
from recon.errors import InputError
from recon.files import atomic, meshes
from recon.geometry import rigid
from recon.model.part import NotNegative, Part
from recon.registry import Choice
from recon.session import skin_step
from recon.session.watch import SILENT, Watch
from recon.tracking import results

Array = NDArray[np.float64]

BY = "certify"  # who writes
PAGE, SHEET, FILE = "certificate.html", "certificate.pdf", "certificate.json"
MESHES = (".ply", ".stl", ".glb")
LEAST_POSES = 10  # of a tool in a divot
CAPTURE = "capture"  # within a place's folder, as `sonotwin render` writes it


class Settings(Part):
    """Sources, certificates and limits."""

    capture: Path
    """folder with the folders sphere, bar and plane; each has a capture, or a mesh in mm (PLY, STL, GLB), a place: 00, 01, ...;
    and with the folder divots of a certified plate: poses of a tool in divot 00, 01, ..., a table as `sonotwin track` writes it,
    or the folder that it wrote; 00-WORDS for another recording in divot 00, such as with the tool turned about one axis; and
    with the folder filaments of a phantom: folders 00, 01, ... of B-scans (PNG), the probe lifted and placed again for each. A
    sphere, bar or plane that is recorded again in its place, 00-WORDS, shows what a whole sequence shifts"""
    artefacts: Annotated[Artefacts, Choice("steel")]
    """certificates of the artefacts, and the volume: a name in conf/artefacts, or a YAML file"""
    limits: Annotated[Limits, Choice("meza2021")]
    """maximum permissible errors: a name in conf/limits, or a YAML file"""
    calibration: Path | None = None
    """calibration file, used instead of the captures' own"""
    tip: Path | None = None
    """tip.yaml of the tool in the divots, as `sonotwin calibrate-tip` writes it"""
    cap_deg: Annotated[float, Field(ge=20, le=85)] = 50.0
    """deg, half angle of the part of a ball that is taken, from the middle of what is seen: at its rim fringes thin out"""
    border_mm: NotNegative = 5.0
    """mm, of a plane, from its outline inwards, that is left out: pixels there see its edge, too"""
    instrument: Annotated[str, Field(max_length=200)] = ""
    """the rig, for the page; "" takes the captures' folder"""
    operator: Annotated[str, Field(max_length=200)] = ""
    """who tested, for the page; "" leaves a line to be filled in"""
    day: Annotated[str, Field(max_length=40)] = ""
    """of the test, for the page; "" leaves a line to be filled in"""
    seed: Annotated[int, Field(ge=0)] = 0
    """of Monte Carlo and bootstrap; the same seed gives the same certificate"""


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> Acceptance:
    """Read, fit, judge and write.

    Raises
    ------
    InputError
        If a capture or mesh is missing or damaged, an artefact isn't in it, or `out` can't be written to.
    """
    atomic.check_folder(out, BY, inputs=(settings.capture, settings.calibration, settings.tip))
    places = places_of(settings.capture, settings.artefacts)
    measured = measure(settings, places, watch)
    found = optical_acceptance.judge(measured, settings.artefacts, settings.limits, settings.seed)
    for line in describe(found):
        watch.say(line)
    subject = certificate_page.Subject(
        settings.instrument or settings.capture.name, settings.operator, settings.day, settings.artefacts
    )
    with watch.busy("writing the certificate"), atomic.new_folder(out, BY) as folder:
        (folder / PAGE).write_text(certificate_page.write_text(found, subject), encoding="utf-8")
        certificate_sheet.write(folder / SHEET, found, subject)
        (folder / FILE).write_text(json.dumps(record(found), indent=2) + "\n", encoding="utf-8")
    watch.say(f"wrote       {out}/{{{PAGE},{SHEET},{FILE}}}")
    return found


def places_of(folder: Path, artefacts: Artefacts) -> dict[str, dict[str, Path]]:
    """Captures and meshes by the artefact's kind and their place's name; InputError if a kind has none."""
    found = {}
    for kind in artefact_points.expected(artefacts):
        own = sorted((folder / kind).iterdir()) if (folder / kind).is_dir() else []
        kinds = {"divots": (".csv",), "filaments": ()}.get(kind, MESHES)
        names = [one for one in own if not one.name.startswith(".") and (one.is_dir() or one.suffix.lower() in kinds)]
        if not names:
            other = {"divots": "a table of poses for each divot", "filaments": "a folder of B-scans for each setting"}
            what = other.get(kind, "a capture or mesh for each place")
            expected = f"a folder with {what}, such as 00"
            raise InputError(f"{folder / kind}: expected {expected}, found none; artefacts.{kind}=null leaves it out")
        found[kind] = {f"{kind}/{re.sub(r'[.][^.]+$', '', one.name)}": one for one in names}
        if len(found[kind]) < len(names):
            two = "a capture and a mesh, or two meshes," if kind != "divots" else "a folder and a table"
            raise InputError(f"{folder / kind}: expected each place once, found {two} of one name")
    return found


def measure(settings: Settings, places: Mapping[str, Mapping[str, Path]], watch: Watch) -> Measured:
    """Points of the artefacts in all places."""
    region, rng = Region(cap_deg=settings.cap_deg, border_mm=settings.border_mm), np.random.default_rng(settings.seed)
    found: dict[str, dict[str, Any]] = {"sphere": {}, "bar": {}, "plane": {}, "divots": {}, "filaments": {}}
    total = sum(map(len, places.values()))
    for name, path in watch.follow([pair for own in places.values() for pair in own.items()], total, "measuring"):
        artefacts = settings.artefacts
        if name.startswith("divots") and artefacts.divots is not None:
            found["divots"][name] = tips_of(path, settings.tip, name, len(artefacts.divots.places_mm))
            continue
        if name.startswith("filaments") and artefacts.filaments is not None:
            images = bscans_of(path)
            found["filaments"][name] = seen = filament_probing.probe_filaments(images, artefacts.filaments, str(path))
            if missing := sorted(set(range(len(artefacts.filaments.places_mm))) - set(seen.numbers)):
                watch.say(f"{name}: not in all of {len(images)} B-scans: filaments {', '.join(map(str, missing))}")
            measured = np.isfinite(seen.widths).all(axis=(0, 2))
            if unknown := [str(number) for number, known in zip(seen.numbers, measured, strict=True) if not known]:
                why = "clipped, so lower the gain, or near another one"
                watch.say(f"{name}: no widths of filaments {', '.join(unknown)}: {why}")
            continue
        points = points_of(path, settings.calibration)
        if name.startswith("sphere") and artefacts.sphere is not None:
            found["sphere"][name] = artefact_points.ball(points, artefacts.sphere.diameter.mm, str(path), region)
        elif name.startswith("bar") and artefacts.bar is not None:
            found["bar"][name] = artefact_points.bar(points, artefacts.bar, str(path), region)
        else:
            found["plane"][name] = artefact_points.plate(points, str(path), rng, region)
    watch.say(f"measured    {', '.join(f'{len(own)} of {kind}' for kind, own in found.items() if own)}")
    return Measured(found["sphere"], found["bar"], found["plane"], found["divots"], found["filaments"])


def bscans_of(folder: Path) -> list[NDArray[np.uint8]]:
    """B-scans of a folder, of one size; InputError where one is damaged or of another size."""
    images = list[NDArray[np.uint8]]()
    for path in image_files(folder):
        first = (images[0].shape[1], images[0].shape[0]) if images else None
        images.append(read_grey(path, first))
    return images


def tips_of(path: Path, tip: Path | None, name: str, divots: int) -> Array:
    """Places : (n, 3) mm of a tool's tip in a divot, by its poses; InputError if there is no table of these, or no such divot."""
    try:
        number = optical_acceptance.divot_number(name)[0]
    except ValueError:
        number = -1
    if not 0 <= number < divots:
        raise InputError(f"{path}: expected a name that begins with a divot's number, 00 to {divots - 1:02d}, found {path.stem}")
    if tip is None:
        raise InputError(
            "tip: expected the tip.yaml of the tool in the divots, found none; artefacts.divots=null leaves them out"
        )
    tip_mm = tip_files.read(tip).tip_mm
    track = sweep_tables.read_track(path if path.is_file() else path / results.POSES)
    poses = track.poses[track.found]
    if len(poses) < LEAST_POSES:
        raise InputError(f"{path}: expected {LEAST_POSES} poses or more of the tool in the divot, found {len(poses)}")
    return np.array([rigid.apply(pose, tip_mm) for pose in poses])


def points_of(path: Path, calibration: Path | None) -> Array:
    """Points : (n, 3) mm of a capture, as `sonotwin surface` finds them, or of a mesh's vertices."""
    if path.is_file():
        return np.asarray(meshes.read_model(path, "an artefact's mesh").vertices, float)
    inner = path if (path / MANIFEST).is_file() else path / CAPTURE
    fields = skin_step.Settings(capture=inner, calibration=calibration)
    shots = surface_part.read_surface(inner, fields.camera, calibration)
    skin = skin_step.reconstruct(shots, fields.camera, others=skin_step.cameras_beside(fields))
    return skin.points.points[np.isfinite(skin.points.points).all(axis=-1)].astype(float)


def describe(found: Acceptance) -> list[str]:
    """A head and a line a quantity, of the place that decides, for the terminal; and the verdict."""
    lines = [_line(("", "worst, mm", "U, mm", "k", "limit, mm", "decision", "at"))]
    for symbol, worst in found.worst_values.items():
        budget = worst.budget
        numbers = (f"{budget.value_mm:+.4f}", f"{budget.expanded_mm:.4f}", f"{budget.k:.2f}")
        limit = "" if worst.limit_mm is None else f"{worst.limit_mm:g}"
        lines.append(_line((symbol, *numbers, limit, found.decision_of(symbol) or "reported", worst.place)))
    lines += [f"demand      {one.words}: found {one.found}" for one in found.demands if not one.met]
    return [*lines, f"verdict     {certificate_page.verdict(found)}"]


def record(found: Acceptance) -> dict[str, Any]:
    """The certificate's numbers, as JSON has them."""
    values = [
        {
            "quantity": one.symbol,
            "iso_10360_13": CHARACTERISTICS[one.symbol].iso or None,
            "place": one.place,
            "points": one.points,
            "value_mm": one.budget.value_mm,
            "standard_uncertainty_mm": one.budget.standard_mm,
            "effective_degrees_of_freedom": one.budget.freedom if np.isfinite(one.budget.freedom) else None,
            "k": one.budget.k,
            "expanded_uncertainty_mm": one.budget.expanded_mm,
            "monte_carlo_mm": one.budget.drawn_mm,
            "limit_mm": one.limit_mm,
            "decision": one.decision,
            "budget": [
                {
                    "input": row.input.name,
                    "type": row.input.kind,
                    "value": row.input.value,
                    "unit": row.input.unit,
                    "standard_uncertainty": row.input.standard,
                    "distribution": row.input.shape,
                    "sensitivity": row.sensitivity,
                    "share": row.share,
                }
                for row in one.budget.rows
            ],
        }
        for one in found.values
    ]
    demands = [one._asdict() for one in found.demands]
    return {"format": "sonotwin-certificate/1", "decision": found.decision, "demands": demands, "values": values}


def _line(cells: tuple[str, ...]) -> str:
    symbol, *numbers, decision, place = cells
    return f"{symbol:12}{''.join(f'{number:>11}' for number in numbers)}  {decision:10}{place}".rstrip()
