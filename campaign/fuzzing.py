"""Coverage-guided fuzzing of each reader (atheris, libFuzzer): whatever the bytes, it gives a value or an InputError.

Each reader is fuzzed in a process of its own, as `python -m campaign.fuzzing READER FOLDER`, begun again after each finding.
Readers that are done are kept until all are, so that a killed run goes on.
"""

import json
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

MOST_MB, LONGEST_S = 2000, 10
MOST_FAULTS = 5  # of one reader, after which it isn't fuzzed on
SPELL_S = 150  # of a process, after which another goes on with its inputs: libFuzzer itself grows by some hundred bytes an input
NAMES = (
    "manifest", "calibration", "calibration_xml", "calibration_npz", "kalibr", "ros", "mrcal", "slstudio",
    "probe", "target", "tip", "lag", "stamps", "track", "authors_poses", "pairs",
    "pose_table", "image", "mesh", "model_stl", "model_glb",
    "volume_nrrd", "volume_mha", "sequence", "plus_config", "plus_phantom", "messages", "dicom",
    "archived_volume", "archived_masses", "archived_surfaces", "archived_report", "patient", "video",
    "patterns", "metrics", "truth", "check_log", "cut", "points", "shard", "centres", "outlines", "checkpoint", "network",
    "mass_network",
)  # fmt: skip


@dataclass
class Fuzzed:
    """What came of fuzzing one reader."""

    reader: str
    seconds: float = 0.0
    inputs: int = 0
    edges: int = 0  # covered
    faults: list[str] = field(default_factory=list)  # last lines of what was raised or said


def run(place: Path, seconds: float, only: Sequence[str] = (), workers: int = 2, inputs: int | None = None) -> list[Fuzzed]:
    """Fuzz readers for some seconds each, or until each had a number of inputs."""
    names = [name for name in NAMES if not only or name in only]
    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(lambda name: _kept(place, name, seconds, inputs), names))
    for name in names:
        _row_file(place, name).unlink()
    return found


def _kept(place: Path, name: str, seconds: float, inputs: int | None) -> Fuzzed:
    """What came of a reader before a run was killed; else fuzz it."""
    from recon.files import atomic  # not on top: a process that fuzzes instruments what it imports

    file = _row_file(place, name)
    if not file.exists():
        found = fuzz(place, name, seconds, inputs)
        with atomic.new_file(file) as temporary:
            temporary.write_text(json.dumps(asdict(found)), encoding="utf-8")
    return Fuzzed(**json.loads(file.read_text(encoding="utf-8")))


def _row_file(place: Path, name: str) -> Path:
    return place.parent / "fuzzing" / f"{name}.json"


def fuzz(place: Path, name: str, seconds: float, inputs: int | None = None) -> Fuzzed:
    """Fuzz one reader; what breaks it is kept in the folder `fuzzing` beside the sources."""
    found, kept = Fuzzed(name), place.parent / "fuzzing" / name
    kept.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        while (left := seconds - (time.perf_counter() - start)) > 1 and len(found.faults) < MOST_FAULTS:
            if inputs is not None and found.inputs >= inputs:
                break
            spell = min(int(left), SPELL_S)
            limits = [f"-max_total_time={spell}", f"-rss_limit_mb={MOST_MB}", f"-timeout={LONGEST_S}"]
            limits += [] if inputs is None else [f"-runs={inputs}"]
            settings = [*limits, f"-artifact_prefix={kept}/", "-print_final_stats=1"]
            line = [sys.executable, "-m", "campaign.fuzzing", name, str(place), folder, *settings]
            done = subprocess.run(line, capture_output=True, check=False, cwd=Path(__file__).resolve().parents[1])
            said = done.stderr.decode(errors="replace") + done.stdout.decode(errors="replace")
            found.inputs += sum(int(number) for number in re.findall(r"stat::number_of_executed_units:\s*(\d+)", said))
            found.edges = max([found.edges, *(int(number) for number in re.findall(r"cov: (\d+)", said))])
            if done.returncode:
                found.faults.append(_cause(said) or f"status {done.returncode}")
    found.seconds = time.perf_counter() - start
    return found


def _cause(said: str) -> str:
    """The line that says what went wrong."""
    raised = r"^(\w[\w.]*(?:Error|Exception|Warning|Iteration|Interrupt|Exit)\b.*)$"
    for pattern in (raised, r"(ERROR: libFuzzer: .*)", r"(.*Sanitizer.*)"):
        if lines := re.findall(pattern, said, re.MULTILINE):
            return lines[-1][:200]
    return said.strip().splitlines()[-1][:200] if said.strip() else ""


def table(found: Sequence[Fuzzed]) -> list[str]:
    """Lines of Markdown: a row a reader with a fault, and one of the others."""
    lines = ["| reader | s of each | inputs | edges covered by each | faults |", "|---|---|---|---|---|"]
    good = [one for one in found if not one.faults]
    rows = [(one.reader, [one]) for one in found if one.faults] + ([(f"{len(good)} readers", good)] if good else [])
    for name, some in rows:
        seconds, edges = [round(one.seconds) for one in some], [one.edges for one in some]
        faults = "; ".join(sorted({fault for one in some for fault in one.faults})) or "none"
        ranges = (f"{min(of)} to {max(of)}" if len(some) > 1 else str(of[0]) for of in (seconds, edges))
        lines.append(f"| {name} | {next(ranges)} | {sum(one.inputs for one in some)} | {next(ranges)} | {faults} |")
    return lines


def main(name: str, place: Path, folder: Path, settings: Sequence[str]) -> None:
    """Fuzz one reader in this process; it ends with the process."""
    import atheris

    with atheris.instrument_imports(  # pyrefly: ignore[missing-attribute]
        include=["recon", "trainers", "twin.session"]
    ):
        from campaign.readers import READERS
    from recon.errors import InputError

    reader = READERS[name]
    corpus = folder / "corpus"  # of the process before, too, whose finds libFuzzer adds
    corpus.mkdir(exist_ok=True)
    for number, seed in enumerate(seed for seed in reader.seeds if (place / seed).exists()):
        (corpus / str(number)).write_bytes((place / seed).read_bytes())
    path = folder / "read" / reader.name
    path.parent.mkdir(exist_ok=True)

    def read(content: bytes) -> None:
        path.write_bytes(content)
        try:
            reader.read(path)
        except InputError as error:
            if len(str(error).splitlines()) != 1:
                raise RuntimeError(f"a message of several lines: {error}") from error

    atheris.Setup([sys.argv[0], *settings, str(corpus)], read)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4:])
