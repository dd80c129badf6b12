"""Where the twin writes: a capture, and its truth beside it."""

from pathlib import Path

from recon import atomic
from recon.manifest import MANIFEST

TRUTH_MARKER = "scene.json"  # tells a folder of truth


def check_places(out: Path) -> None:
    """Check, before any long work, that capture and truth can be written.

    Raises
    ------
    InputError
        If something else is there.
    """
    for folder, marker in ((out / "truth", TRUTH_MARKER), (out / "capture", MANIFEST)):
        atomic.check_folder(folder, marker)
