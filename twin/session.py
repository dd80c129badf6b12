"""A session of the twin: a capture, and beside it the truth that it was rendered from. Both are written and read here alone.

OUT/capture/ may hold several parts, and OUT/truth/ then holds the truth of each:

- `surface/`, `board.npz`, `sweep/` or `sweep/NAME/`: arrays and images of the part of that name;
- `calibration/optics.yaml`: the true cameras and projector, one for all parts;
- `scene.json` and `settings.json`: the scene, and all that the part was rendered from; those of the part that was written first
  lie in `truth/` itself, those of a part that was added to it in `truth/PART/`.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.capture import calibration_files
from recon.capture.manifest import MANIFEST, OPTICS, SWEEP, PartName, Purpose, is_sweep, read_manifest
from recon.capture.writer import SHARED, CaptureWriter, check_kept
from recon.errors import InputError
from recon.files import atomic, json_text, npz
from recon.files.written_files import Addition
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from scenes.scene_types import Scene

CAPTURE, TRUTH = "capture", "truth"
SCENE = "scene.json"
SETTINGS = "settings.json"
TWIN = "the twin"  # who writes captures and truths


@dataclass(frozen=True)
class TruthFolder:
    """The truth of one part, in a folder of truth."""

    folder: Path
    part: PartName

    @property
    def described(self) -> Path:
        """The folder of the part's `scene.json` and `settings.json`."""
        own = self.own
        return own if (own / SCENE).is_file() else self.folder

    @property
    def own(self) -> Path:
        """The part's own folder."""
        return self.folder / self.part

    def scene(self) -> dict:
        """Read the description of the scene; InputError if it is missing or damaged."""
        return read_json(self.described / SCENE)

    def settings(self) -> dict:
        """Read the fields that the part was rendered from; InputError if they are missing or damaged."""
        return read_json(self.described / SETTINGS)

    def arrays(self, name: str, forms: Mapping[str, npz.Form]) -> dict[str, NDArray]:
        """Read arrays from a file in the folder; InputError if one is missing or damaged."""
        return npz.read(self.folder / name, forms)

    def optics(self, *names: str) -> dict[str, Camera]:
        """Read the true calibration; InputError if it is missing or damaged, or lacks one of the devices."""
        path = self.folder / OPTICS
        cameras = dict(calibration_files.read(path).cameras)
        if missing := [name for name in names if name not in cameras]:
            raise InputError(f"{path}: expected {missing[0]}, found {', '.join(cameras) or 'none'}")
        return cameras

    def write_arrays(self, name: str, arrays: Mapping[str, NDArray]) -> None:
        """Write arrays into a file in the folder."""
        (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
        np.savez(self.folder / name, **arrays)

    def write_optics(self, optics: Calibration) -> None:
        """Write the true calibration."""
        calibration_files.extend(self.folder / OPTICS, optics)


@dataclass(frozen=True)
class Session:
    """One part that is rendered into a folder `out`."""

    out: Path
    part: PartName
    settings: Mapping[str, object]  # that it is rendered from
    add: bool = False  # to the capture that is there, in place of its part of that name; else only such a part may be there
    devices: tuple[str, ...] = ()  # of a sweep: those whose images it has
    purpose: Purpose | None = None  # of a sweep

    @property
    def capture(self) -> Path:
        """The folder of the capture."""
        return self.out / CAPTURE

    @property
    def truth(self) -> TruthFolder:
        """The part's truth."""
        return TruthFolder(self.out / TRUTH, self.part)

    @property
    def _adds(self) -> Addition | None:
        """The part as one of a capture that may have others."""
        return Addition(SHARED, self.part) if self.add else None

    def check(self) -> None:
        """Check, before any long work, that capture and truth can be written; puts back what a process that was killed set aside.

        Raises
        ------
        InputError
            If something else is there: other files, other parts that would be lost, a sweep of other devices in the place of this
            one, parts that can't stay where they are, or parts rendered with another rig.
        """
        atomic.check_folder(self.truth.folder, TWIN)
        atomic.check_folder(self.capture, TWIN, adds=self._adds)
        atomic.restore((self.truth.folder, self.capture))
        self._check_parts()

    def _check_parts(self) -> None:
        """Check that no other part would be lost, and that all are of one rig."""
        if not (self.capture / MANIFEST).is_file():
            return
        read = read_manifest(self.capture)
        held = read.contents
        same = not is_sweep(self.part) or set(held.get(self.part, self.devices)) == set(self.devices)
        mine = {self.part} if same else set()
        others = [part for part in held if part not in mine]
        unnamed = SWEEP in (self.part, *held) and is_sweep(self.part)  # beside which no other sweep has a place
        refused = [part for part in others if not self.add or part == self.part or (unnamed and is_sweep(part))]
        if refused:
            found = " and a ".join(_label(part, held[part]) for part in refused)
            named = self.add and unnamed and self.part not in refused
            way = "choose another out" if self.add or self.part in refused else "choose another out, or give add=true"
            way = "choose another out, or give all sweeps names" if named else way
            wanted = _label(self.part, self.devices)
            raise InputError(f"{self.capture}: expected nothing or an earlier {wanted}, found a {found}; {way}")
        if others:
            check_kept(self.capture, read, self.part)
        for part in others:
            path = TruthFolder(self.truth.folder, part).described / SETTINGS
            there, given = (settings.get("rig") for settings in (read_json(path) if path.is_file() else {}, self.settings))
            if there is None or given is None:
                continue
            field, wanted, found = first_difference(given, there, "rig")
            if field:
                raise InputError(f"{path}: {field}: expected {wanted} as given, as all parts are of one rig, found {found}")

    @contextmanager
    def write(self, scene: Mapping[str, object]) -> Iterator[tuple[CaptureWriter, TruthFolder]]:
        """Give the writers of the capture and of its truth; both appear whole and together, or the old ones stay.

        Waits for another process that writes into `out`, so that the part which that one adds is kept too.

        Parameters
        ----------
        scene : as of `describe`
        """
        places = {self.truth.folder: TWIN, self.capture: TWIN}
        with atomic.new_folders(places, {self.capture: self._adds} if self._adds else {}) as (folder, capture):
            self._check_parts()
            writer, truth = CaptureWriter(capture, str(scene["name"])), TruthFolder(folder, self.part)
            kept = writer.keep(self.capture, self.part) if self.add and (self.capture / MANIFEST).is_file() else ()
            place = self._keep_truth(folder, kept) if kept else folder
            place.mkdir(parents=True, exist_ok=True)
            write_json(place / SETTINGS, self.settings)
            write_json(place / SCENE, scene)
            yield writer, truth
            writer.finish()

    def _keep_truth(self, folder: Path, kept: tuple[PartName, ...]) -> Path:
        """Take over the truth of parts that are kept; returns the folder in which the new part is described."""
        before = self.truth.folder
        taken = (before / SCENE).is_file() and any(TruthFolder(before, part).described == before for part in kept)
        mine = {self.part, f"{self.part}.npz"} if taken else {self.part, f"{self.part}.npz", SCENE, SETTINGS}
        if before.is_dir():
            atomic.link_tree(before, folder, leave_out=mine)
        return folder / self.part if taken else folder


def describe(scene: Scene, **more: object) -> dict[str, object]:
    """Describe a scene for evaluation: its name, what is drawn or usual in it, what a part adds, and primitives."""
    shapes = []
    for shape in scene.shapes:
        values = {key: np.asarray(value).tolist() for key, value in asdict(shape).items()}
        shapes.append({"kind": type(shape).__name__.lower(), **values})
    return {"name": scene.name, **scene.filled, **more, "shapes": shapes}


def write_json(path: Path, content: object) -> None:
    """Write a description or settings."""
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read_json(path: Path) -> dict:
    """Read a description or settings; InputError if the file is missing or damaged."""
    content = json_text.read(path, "a file of the twin's ground truth")
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object, found a {type(content).__name__}, damaged or of something else")
    return content


def first_difference(wanted: Any, found: Any, name: str = "") -> tuple[str, Any, Any]:
    """Dotted name and both values of the first field that differs, below a field of the given name; no name if none does."""
    if not (isinstance(wanted, Mapping) and isinstance(found, Mapping)):
        return ("", None, None) if wanted == found else (name, wanted, found)
    for key in {**wanted, **found}:
        different = first_difference(wanted.get(key), found.get(key), f"{name}.{key}".removeprefix("."))
        if different[0]:
            return different
    return "", None, None


def _label(part: PartName, devices: tuple[str, ...]) -> str:
    """A part's name in messages; of a sweep with its devices."""
    own = part.partition("/")[2]
    return f"sweep {own} of {' and '.join(devices)}".replace("  ", " ") if is_sweep(part) else part
