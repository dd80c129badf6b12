"""Where the twin writes: a capture, and its truth beside it."""

from pathlib import Path
from typing import Literal

from recon.capture.manifest import MANIFEST, Manifest, read_manifest
from recon.capture.sweep_part import SCANNER
from recon.errors import InputError
from recon.files import atomic

TRUTH_MARKER = "scene.json"  # tells a folder of truth

Kind = Literal["surface", "board", "sweep", "film"]


def check_places(out: Path, kind: Kind) -> None:
    """Check, before any long work, that capture and truth can be written.

    Raises
    ------
    InputError
        If something else is there, also a capture of another kind.
    """
    for folder, marker in ((out / "truth", TRUTH_MARKER), (out / "capture", MANIFEST)):
        atomic.check_folder(folder, marker)
    if (out / "capture" / MANIFEST).is_file():
        others = kinds_of(read_manifest(out / "capture")) - {kind}
        if others:
            found = " and ".join(sorted(others))
            raise InputError(f"{out / 'capture'}: expected nothing or an earlier {kind}, found a {found}; choose another out")


def kinds_of(manifest: Manifest) -> set[str]:
    """What a capture holds; a film is a sweep without B-scans."""
    held = {part for part in ("surface", "board", "sweep") if getattr(manifest, part) is not None}
    if manifest.sweep is not None and SCANNER not in manifest.sweep.images:
        held = held - {"sweep"} | {"film"}
    return held
