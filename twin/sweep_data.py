"""Data sets of sweeps: each of its own patient and hand, in a folder of its own, whatever the engine and its workers."""

from collections.abc import Generator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from recon.capture.manifest import MANIFEST, SCANNER, sweep_part
from recon.errors import InputError, brief
from recon.files import atomic
from scenes.catalogue import parse_scene
from twin.engine import Engine, results
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.session import CAPTURE, SETTINGS, TRUTH, Session, first_difference, read_json
from twin.ultrasound import sweep_session


def missing(out: Path, settings: SweepSettings, count: int) -> list[int]:
    """Numbers of the sweeps that aren't there yet.

    Raises
    ------
    InputError
        If a sweep of other settings, or something else, is in the place of one.
    """
    if (single := out / CAPTURE).is_dir():
        raise InputError(f"{single}: expected nothing, found a single sweep beside which many would be; choose another out")
    found = []
    for number in range(count):
        one = _session(out, settings, number)
        path = one.truth.folder / SETTINGS
        if path.is_file() and (one.capture / MANIFEST).is_file():
            stored = read_json(path)
            name, wanted, there = _difference(one.settings, stored)
            if name:
                with suppress(InputError, ValidationError):  # a field that is gone
                    name, wanted, there = _difference(_complete(one.settings), _complete(stored))
            if name:
                expected = f"expected {brief(wanted)} as in this run, found {brief(there)}, another sweep"
                raise InputError(f"{path}: {name}: {expected}; choose another out")
        else:
            one.check()
            found.append(number)
    return found


def check_alone(out: Path) -> None:
    """Refuse the folder of many sweeps for a single one; InputError."""
    first = out / _name(0) / CAPTURE
    if first.is_dir():
        raise InputError(f"{first}: expected nothing, found the first of many sweeps; choose another out, or give count")


def make(out: Path, settings: SweepSettings, numbers: list[int], engine: Engine) -> Generator[int, None, None]:
    """Render sweeps; gives the B-scans of each as it is done. However it ends, nothing temporary and no empty folder is left."""
    places = [*(out / _name(number) for number in numbers), out, *out.parents]
    absent = [place for place in places if not place.exists()]
    try:
        yield from results(engine, write, ((out, settings, number) for number in numbers))
    finally:
        for number in numbers:  # of workers that were ended with this process
            folder = out / _name(number)
            atomic.restore((folder / TRUTH, folder / CAPTURE))
        for place in absent:
            with suppress(OSError):
                place.rmdir()


def write(out: Path, settings: SweepSettings, number: int) -> int:
    """Render the sweep of a number, and write it with its truth; gives its B-scans."""
    try:
        planned = plan_sweep(numbered(settings, number))
    except InputError as error:
        raise InputError(f"sweep {_name(number)}: {error}") from None
    planned.write(_session(out, settings, number), planned.scans())
    return len(planned.plan.times)


def numbered(settings: SweepSettings, number: int) -> SweepSettings:
    """The settings of a sweep: of another seed, and of another patient where a scene is drawn by one, also with its own masses.

    Scenes count from `scene.seed` on by the sweep's seed, so that runs of seeds apart share none. Given masses are kept.
    """
    scene, parsed = settings.scene, parse_scene(settings.scene)[1]
    fields = type(parsed).model_fields
    if "seed" in fields:
        scene = scene | {"seed": parsed.seed + settings.seed + number}
    if "masses" in fields and parsed.masses is None:
        scene = scene | {"masses": "drawn"}
    return settings.model_copy(update={"seed": settings.seed + number, "scene": scene})


def _difference(wanted: Mapping[str, Any], found: Mapping[str, Any]) -> tuple[str, Any, Any]:
    """As `first_difference`: the seed first, by which scenes differ, too."""
    return first_difference({"seed": wanted["seed"], **wanted}, found)


def _complete(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Stored settings with the defaults of fields that they lack: there may have been no such fields when they were written."""
    read = SweepSettings.model_validate(settings)
    scene = {"kind": read.scene.get("kind"), **parse_scene(read.scene)[1].model_dump(mode="json")}
    return read.model_dump(mode="json") | {"scene": scene}


def _name(number: int) -> str:
    return f"{number:06d}"


def _session(out: Path, settings: SweepSettings, number: int) -> Session:
    chosen = numbered(settings, number)
    purpose = sweep_session.PURPOSES[chosen.path.kind] if chosen.name else None
    return Session(
        out / _name(number), sweep_part(chosen.name), chosen.model_dump(mode="json"), devices=(SCANNER,), purpose=purpose
    )
