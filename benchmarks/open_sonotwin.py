"""This software on the open benchmark, by its command line; a step that is refused leaves no result.

python benchmarks/open_sonotwin.py SESSIONS RESULTS
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path


def sonotwin(*fields: str) -> bool:
    """Run a verb; whether it did its work."""
    return subprocess.run([sys.executable, "-m", "sonotwin", *fields], check=False).returncode == 0


def solve(session: Path, out: Path) -> None:
    """Put a session's results into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    about, work = json.loads((session / "session.json").read_text(encoding="utf-8")), out.with_name(f".{out.name}")
    given, made = f"capture={session}", f"out={work}"
    match about["task"]:
        case "optics" if sonotwin("calibrate-optics", given, made):
            shutil.copy(work / "optics.yaml", out / "calibration.yaml")
        case "tracking" if sonotwin("track", given, made):
            shutil.copy(work / "poses.csv", out)
        case "surface" if sonotwin("surface", given, made):
            shutil.copy(work / "surface.ply", out)
        case "ultrasound":
            known = (f"lag_s={max(about['lag_s'], 0)}", f"tissue_m_s={about['tissue_m_s']}")
            if sonotwin("freehand", given, *known, made):
                shutil.copy(work / "volume.nrrd", out)
            if sonotwin("segment", given, *known, f"out={work}-masses"):
                (out / "masses").mkdir(exist_ok=True)
                for mesh in Path(f"{work}-masses").glob("mass*.ply"):
                    shutil.copy(mesh, out / "masses")
    for folder in (work, Path(f"{work}-masses")):
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    given, results = map(Path, sys.argv[1:3])
    for one in sorted(given.iterdir()):
        solve(one, results / one.name)
